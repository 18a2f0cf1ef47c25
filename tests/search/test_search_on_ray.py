"""Searches on Ray: the trials of a search in this process, to the bit, whatever happens to the workers."""

import subprocess
import sys

import jax
import numpy as np
import pytest
from click.testing import CliRunner

from tests.on_ray import TWO_CORES, killed_worker
from tests.search.test_search import space  # noqa: F401  (a fixture)
from uavmec_jax.cli import main
from uavmec_jax.cluster.connection import connect
from uavmec_jax.errors import StudyError
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.search.confirm import BASELINE, BEST
from uavmec_jax.search.halving import SuccessiveHalving
from uavmec_jax.search.search import run_search
from uavmec_jax.training import on_ray, partition
from uavmec_jax.training.machine import probe_node

pytestmark = pytest.mark.ray

TRIALS = [{"learning_rate": rate, "hidden": [16, 16], "reward.M": 0.5} for rate in (1e-3, 1e-4, 3e-4, 1e30)]


@pytest.fixture(scope="module", autouse=True)
def cluster():
    with connect(TWO_CORES) as cluster:
        yield cluster


@pytest.fixture(autouse=True)
def _two_shards(monkeypatch):
    """Let a batch be two shards until its rung, and one afterwards."""
    monkeypatch.setattr(partition, "AGENTS_PER_CORE", 2)


def test_a_search_with_its_runs_has_the_same_files_on_ray(space, tmp_path):  # noqa: F811
    run_search(space.model_copy(update={"trials": 4}), tmp_path / "here")
    arguments = ["search", "space.toml", "--trials", "4", "--out", "there", "--cpus-per-shard", "2", "--ray"]
    done = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    for name in ("trials.csv", "best.toml"):
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()
    for name in (BASELINE, BEST):
        assert load_results(tmp_path / "there" / name).run["complete"]


@pytest.fixture
def evaluated(monkeypatch):
    """The weights that are evaluated, batch by batch: short trainings differ in them, and hardly in their lifetimes."""
    weights, objective = [], SuccessiveHalving._objective

    def record(self, agents, trained, algorithm):
        weights.append(trained)
        return objective(self, agents, trained, algorithm)

    monkeypatch.setattr(SuccessiveHalving, "_objective", record)
    return weights


def test_a_worker_is_killed_in_each_stretch_of_a_batch(space, cluster, evaluated):  # noqa: F811
    reference = SuccessiveHalving(space).run(TRIALS)
    assert [outcome.value is None for outcome in reference].count(True) == 2
    shares = []
    halving = SuccessiveHalving(
        space, cluster, probe_node(cluster), lambda share, trials: shares.append((share, trials))
    )
    with killed_worker(task=1) as first, killed_worker(task=0, after=lambda: len(shares) == 2) as second:
        assert halving.run(TRIALS) == reference
    assert first
    assert second
    jax.tree.map(np.testing.assert_array_equal, *evaluated)
    assert [trials for _, trials in shares] == [4, 4, 2]
    assert shares[-1][0] == 1


def fail(*arguments):
    raise RuntimeError("the node is on fire")


def test_a_shard_that_fails_ends_the_search_in_one_line(space, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setattr(on_ray, "train_shard", fail)
    with pytest.raises(
        StudyError, match=r"^shard \d of 2 failed on the Ray cluster: RuntimeError: the node is on fire$"
    ):
        run_search(space, tmp_path / "failed", ray=TWO_CORES)


def test_ray_is_not_imported_without_the_option():
    imports = "import sys, uavmec_jax.search.search, uavmec_jax.search.confirm, uavmec_jax.training.sweep"
    subprocess.run([sys.executable, "-c", f"{imports}; assert 'ray' not in sys.modules"], check=True, timeout=120)

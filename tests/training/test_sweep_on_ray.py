"""``um.train`` on Ray: the bits of a sweep in this process, whatever happens to the workers."""

import jax
import numpy as np
import pytest

import uavmec_jax as um
from tests.on_ray import TWO_CORES, killed_worker
from uavmec_jax.cluster.connection import connect
from uavmec_jax.training import on_ray, partition
from uavmec_jax.training.to_host import from_host, to_host

pytestmark = pytest.mark.ray


@pytest.fixture(scope="module", autouse=True)
def _cluster():
    with connect(TWO_CORES):
        yield


@pytest.fixture
def sweep(monkeypatch):
    """A sweep of seven agents, in two shards, as a function of ``ray``."""
    monkeypatch.setattr(partition, "AGENTS_PER_CORE", 2)

    def make(key, connected):
        return um.make_scenario(um.sample_layout(key, um.Params(), 12, connected), reward=um.make_reward("U"))

    scenarios = jax.vmap(make)(jax.random.split(jax.random.key(0), 7), np.array([12, 8, 8, 4, 4, 2, 2]))
    settings = {"hidden": (16,), "n_envs": 2}
    validation = um.training.Validation(every=500, draws=2)

    def train(ray, **others):
        key, rates = jax.random.key(1), np.geomspace(1e-4, 1e-2, 7)
        hyper = {"learning_rate": rates}
        return um.train(
            "a2c",
            scenarios,
            key=key,
            steps=2000,
            hyper=hyper,
            settings=settings,
            validation=validation,
            ray=ray,
            **others,
        )

    return train


def same_bits(one, other):
    fields = [{name: value for name, value in vars(each.result).items() if name != "seconds"} for each in (one, other)]
    jax.tree.map(np.testing.assert_array_equal, *fields)
    return True


def test_a_sweep_has_the_same_bits_on_ray_and_where_a_worker_is_killed(sweep):
    here = sweep(None)
    reports = []
    assert same_bits(here, sweep(TWO_CORES, on_progress=reports.append))
    assert [(report.shard, report.steps, report.total_steps) for report in reports] == [
        (0, 8000, 14000),
        (1, 14000, 14000),
    ]
    with killed_worker(task=1) as killed:
        assert same_bits(here, sweep(TWO_CORES))
    assert killed


def fail(*arguments):
    raise ValueError("no such luck\nand more")


def test_a_shard_that_fails_is_one_line(sweep, monkeypatch):
    monkeypatch.setattr(on_ray, "train_shard", fail)
    with pytest.raises(um.UserError, match=r"^shard \d of 2 failed on the Ray cluster: ValueError: no such luck$"):
        sweep(TWO_CORES)


def test_keys_travel_as_their_data():
    tree = {"key": jax.random.split(jax.random.key(3), 2), "values": np.arange(2, dtype=np.int32)}
    data = to_host(tree)
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(data))
    back = from_host(data)
    assert back["key"].dtype == tree["key"].dtype
    assert (jax.random.key_data(back["key"]) == jax.random.key_data(tree["key"])).all()
    assert back["values"].dtype == np.int32

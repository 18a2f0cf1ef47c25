"""Runs of many agents: planning and status are quick; too many agents are refused."""

import pytest

from tests.runs.processes import TINY, plan_in
from uavmec_jax.errors import ArgumentError, StudyError
from uavmec_jax.runs import shard_runner
from uavmec_jax.runs.checkpoints import interval_s
from uavmec_jax.runs.run import run_study
from uavmec_jax.runs.run_plan import plan_run
from uavmec_jax.runs.simulate import simulate
from uavmec_jax.runs.status import run_status
from uavmec_jax.studies import population
from uavmec_jax.studies.study import load_study, parse_study


def test_a_hundred_thousand_agents_are_planned_without_making_one(tmp_path, monkeypatch):
    def refuse(study):
        raise AssertionError("the agents were enumerated")

    for module in (population, shard_runner):
        monkeypatch.setattr(module, "make_agent_ids", refuse)
    study = parse_study(TINY, "tiny", {"axes.seeds": 50_000})
    plan_in(tmp_path / "run", study)
    status = run_status(tmp_path / "run")
    assert status.agents == 100_000
    assert status.shards["waiting"] > 1000
    assert status.total_steps == 100_000 * 4000
    assert not (tmp_path / "run" / "shards").exists()


def test_large_checkpoints_are_written_less_often():
    assert interval_s(60.0, 0.02, size=1e6) == 60.0
    assert interval_s(60.0, 0.02, size=1e6, cost_s=3.0) == pytest.approx(150.0)
    assert interval_s(0.0, 0.1, size=1.5e9) == pytest.approx(100.0)  # at 150 MB/s, before the first is timed


@pytest.mark.parametrize("size", [-4, 0])
def test_a_shard_size_that_cannot_be_is_refused_before_anything_is_written(tmp_path, size):
    study = parse_study(TINY, "tiny")
    for use in (
        lambda: plan_run(study, shard_size=size),
        lambda: run_study(study, tmp_path / "run", shard_size=size),
    ):
        with pytest.raises(ArgumentError, match=f"^shard_size is {size}; it should be a whole number of at least 1$"):
            use()
    assert not (tmp_path / "run").exists()


def test_a_population_beyond_all_memory_is_refused_with_an_estimate(tmp_path):
    study = parse_study(TINY, "tiny", {"axes.seeds": 500_000_000})
    for use in (plan_run, lambda s: run_study(s, tmp_path / "run")):
        with pytest.raises(StudyError, match=r"1,000,000,000 agents need 93,132 GiB of memory, and as much disk"):
            use(study)
    assert not (tmp_path / "run").exists()


def test_a_simulation_adds_up():
    study = load_study("table5", {"axes.seeds": 8})  # 200 agents
    plan = plan_run(study, shard_size=40)
    groups = plan.partitions["dqn"].groups
    one, two = (simulate(study, plan, speed=100_000, devices=n * groups) for n in (1, 2))
    assert one.training_s == pytest.approx(200 * 1_000_000 / (100_000 * groups), rel=0.01)
    assert two.training_s == pytest.approx(one.training_s * 3 / 5, rel=0.01)  # five shards, two at a time
    assert (one.shards_at_once, two.shards_at_once) == (1, 2)
    fast = simulate(study, plan, speed={"dqn": 200_000}, devices=groups)
    assert fast.training_s == pytest.approx(one.training_s / 2)
    assert fast.other_s == one.other_s
    assert one.memory_bytes > plan.partitions["dqn"].shard_bytes
    assert "wall time" in str(one)
    assert one.as_json()["wall_s"] == one.training_s + one.other_s

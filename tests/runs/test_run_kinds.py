"""Runs with reward functions, with diverging agents, with TensorBoard."""

import pytest

from tests.runs.processes import TINY, bits, events, stop_after
from tests.runs.test_log import read_scalars
from uavmec_jax.errors import StudyError
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.run import resume_run, run_study
from uavmec_jax.studies.study import parse_study

pytestmark = pytest.mark.slow

STUDY = parse_study(TINY, "tiny")


def test_resuming_needs_the_reward_function_again(tmp_path):
    def survival(terms):
        return terms["U"]

    run_study(STUDY, tmp_path / "run", reward=survival, command="x", shard_size=2, on_progress=stop_after(3))
    with pytest.raises(
        StudyError, match=r"was started with the reward function .*survival; give it to um.runs.resume_run"
    ):
        resume_run(tmp_path / "run")
    for use in (
        lambda: run_study(STUDY, tmp_path / "other", reward=survival, ray=True),
        lambda: resume_run(tmp_path / "run", reward=survival, ray=True),
    ):
        with pytest.raises(StudyError, match=r"a run on Ray (needs a directory and|takes) no reward function"):
            use()
    again = resume_run(tmp_path / "run", reward=survival)
    assert again.run["complete"]
    assert again.run["reward_function"].endswith("survival")


@pytest.mark.parametrize(
    ("algorithm", "observation"),
    [
        ("dqn", "full"),
        ("ppo", "paper"),
        ("pqn", "paper"),
        pytest.param("dqn", "paper", marks=pytest.mark.full),
    ],
)
def test_a_stopped_run_of_any_algorithm_is_resumed_with_the_same_bits(tmp_path, algorithm, observation):
    settings = {"ppo": {"n_steps": 32, "batch_size": 32}, "pqn": {"n_envs": 4, "n_steps": 8, "batch_size": 16}}
    changes = {f"{algorithm}.{name}": size for name, size in settings.get(algorithm, {}).items()}
    changes |= {
        f"{algorithm}.observation": observation,
        "algorithm": algorithm,
        "steps": 1500,
        "axes.powered": [8],
        f"{algorithm}.hidden": [8],
    }
    study = parse_study(TINY, "tiny", changes)
    run_study(study, tmp_path / "whole", command="x")
    often = RunOptions(checkpoint_every_s=0.0)
    results = run_study(study, tmp_path / "run", command="x", options=often, on_progress=stop_after(3))
    assert results.run["stopped_by"] == 2
    assert list((tmp_path / "run" / "shards" / "00000").glob("checkpoint-*.npz"))
    assert resume_run(tmp_path / "run").run["complete"]
    assert bits(tmp_path / "run") == bits(tmp_path / "whole")


def test_agents_that_diverge_do_not_affect_the_others():
    """Train with a learning rate of 1e12 beside a sensible one (NaN and infinity: `tests/agents/test_dqn.py`)."""
    rates = {"axes.learning_rate": [7e-4, 1e12], "axes.powered": [8], "algorithm": "dqn", "steps": 1000}
    both = run_study(parse_study(TINY, "tiny", rates)).agents
    assert (both["diverged_at"] >= 0).tolist() == [False, True, False, True]


def test_curves_are_also_written_for_tensorboard(tmp_path):
    run_study(STUDY, tmp_path / "run", options=RunOptions(tensorboard=True))
    values = read_scalars(tmp_path / "run" / "tensorboard" / "shard-00000")
    chunks = events(tmp_path / "run", "chunk")
    assert values["episode_length"] == pytest.approx([chunk["episode_length"] for chunk in chunks])
    assert len(values["validation"]) == 8
    assert set(values) == {"episode_length", "validation", "steps_per_second"}

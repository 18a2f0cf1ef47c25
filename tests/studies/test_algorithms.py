"""Studies of several algorithms, and of rewards that are functions."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal

from uavmec_jax.errors import StudyError
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.runs.run import run_study
from uavmec_jax.runs.run_plan import plan_run
from uavmec_jax.studies.evaluation import DistinctScenarios
from uavmec_jax.studies.evaluation_result import EvaluationResult, PlannerResult
from uavmec_jax.studies.results_files import load_weights
from uavmec_jax.studies.study import parse_study
from uavmec_jax.training.population import Progress

TOML = """
name = "four"
steps = 640
[axes]
algorithm = ["dqn", "ppo", "a2c", "pqn"]
cells = [[8, 8], [6, 6]]
seeds = 2
reward = ["U", "U+log(A/O)"]
guard = ["clamp", "log1p"]
[dqn]
hidden = [16]
[ppo]
hidden = [16]
n_steps = 64
n_envs = 2
[a2c]
hidden = [16]
[pqn]
hidden = [16]
n_envs = 4
n_steps = 16
[evaluation]
draws = 3
validate_every = 320
validation_draws = 2
planner_draws = 2
planners = ["rollout", "bound"]
baselines = ["oldest-first"]
"""


@pytest.mark.slow
def test_one_study_trains_each_algorithm_as_one_program(tmp_path):
    study = parse_study(TOML, "four")
    plan = plan_run(study)
    assert plan.agents == 4 * 2 * 2 * 3  # the reward U has one guard
    assert list(plan.partitions) == ["dqn", "ppo", "a2c", "pqn"]
    reports: list[Progress] = []
    results = run_study(study, tmp_path / "run", on_progress=reports.append)
    assert results.run["complete"]
    assert [report.steps for report in reports] == sorted(report.steps for report in reports)
    assert reports[-1].steps == reports[-1].total_steps == plan.total_steps == results.run["environment_steps"]
    assert {report.shard for report in reports} == {0, 1, 2, 3}
    assert results.agents["algorithm"].tolist() == ["dqn"] * 12 + ["ppo"] * 12 + ["a2c"] * 12 + ["pqn"] * 12
    assert results.agents.groupby("algorithm")["steps"].first().to_dict() == dict.fromkeys(plan.partitions, 640)
    # heuristics and planners have the same results for all agents of a scenario
    for column in ("oldest_first_lifetime", "rollout_planned", "bound_planned"):
        assert (results.agents.groupby(["seed", "powered", "connected"])[column].nunique() == 1).all()
    assert (results.agents["bound_planned"] >= results.agents["best_planned"]).all()

    again = load_results(tmp_path / "run")
    assert list(again.curves) == ["dqn", "ppo", "a2c", "pqn"]
    assert again.curves["ppo"]["validation"].shape == (12, 3)  # validated after 2, 4 and 5 rollouts of 128 steps
    assert "critic" in load_weights(tmp_path / "run", algorithm="a2c")["params"]
    pd.testing.assert_frame_equal(again.cells(), results.cells(), rtol=1e-4)

    text = TOML.replace('["dqn", "ppo", "a2c", "pqn"]', '["ppo"]')
    for other in ("dqn", "a2c", "pqn"):
        text = text.replace(f"[{other}]\nhidden = [16]\n", "")
    text = text.replace("n_envs = 4\nn_steps = 16\n", "")
    alone = run_study(parse_study(text, "alone"))
    together = results.agents.query("algorithm == 'ppo'").reset_index(drop=True)
    pd.testing.assert_frame_equal(alone.agents, together)


@pytest.mark.slow
def test_a_function_is_a_reward_for_a_whole_study():
    few = {"axes.powered": [8], "axes.connected": [8], "axes.seeds": 2, "steps": 400}
    settings = (
        "[evaluation]\nplanners = []\nbaselines = []\ndraws = 3\nvalidate_every = 200\nvalidation_draws = 2\n[axes]\n"
    )
    study = parse_study(settings, "mine", few)

    def product(terms):
        return terms["U"] * terms["M"]

    results = run_study(study, reward=product)
    assert results.run["reward_function"].endswith("product")
    linear = run_study(study)
    assert "reward_function" not in linear.run
    key = "dqn/last/params/TorchDense_0/kernel"
    assert (results.weights[key] != linear.weights[key]).any()


def test_a_function_beside_an_axis_of_rewards_is_refused():
    study = parse_study("[axes]\npowered = [8]\nconnected = [8]\nseeds = 1\nreward = ['A', 'U']", "two")
    with pytest.raises(StudyError, match=r"two: axes.reward is given, and a reward function too"):
        run_study(study, reward=lambda terms: terms["A"])


def test_distinct_scenarios():
    distinct = DistinctScenarios.of(pd.DataFrame({"seed": [1, 1, 0, 1], "powered": [8, 6, 8, 8]}))
    assert_array_equal(distinct.first, [0, 1, 2])
    assert_array_equal(distinct.scenario, [0, 1, 2, 0])
    assert_array_equal(distinct.longest(np.array([[3, 1], [5, 5], [2, 2], [1, 4]])), [[3, 4], [5, 5], [2, 2]])
    lifetime = np.array([[7, 8], [9, 9], [1, 2]])
    result = distinct.to_agents(EvaluationResult(lifetime, np.zeros((3, 2), np.int8), np.zeros((3, 2, 4))))
    assert_array_equal(result.lifetime, [[7, 8], [9, 9], [1, 2], [7, 8]])
    assert result.first_failure.shape == (4, 2, 4)
    bound = distinct.to_agents(PlannerResult(lifetime))
    assert_array_equal(bound.lifetime, result.lifetime)
    assert bound.cause is None

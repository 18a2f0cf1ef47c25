"""Study files: valid ones become populations, others are refused in one line."""

import chex
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from uavmec_jax.env.rewards import REWARDS
from uavmec_jax.errors import StudyError
from uavmec_jax.studies.paper import TABLE6
from uavmec_jax.studies.parts import split_study
from uavmec_jax.studies.population import (
    evaluation_keys,
    make_agent_ids,
    make_agents,
    make_algorithm,
    n_agents,
    validation_keys,
)
from uavmec_jax.studies.study import load_study, parse_study, shipped_studies, study_toml

SMALL = """
steps = 400
[axes]
powered = [8, 4]
connected = [6]
seeds = 2
"""


@pytest.mark.parametrize("name", sorted(shipped_studies()))
def test_shipped_studies_are_valid_and_round_trip(name):
    study = load_study(name)
    assert study.name == name
    assert parse_study(study_toml(study), "again") == study
    sizes = {
        "fleet": 7500,
        "planning": 2500,
        "table6": 675,
        "table7": 240,
        "table7-ppo": 120,
        "generalist": 2,
        "generalist-pqn": 2,
    }
    assert n_agents(study) == len(make_agent_ids(study)) == sizes.get(name, 250)


def test_table5_is_the_paper():
    study = load_study("table5")
    assert study.axes["powered"] == study.axes["connected"] == [12, 10, 8, 6, 4]
    assert (study.steps, study.reward, study.guard) == (1_000_000, "U+log(A/O)", "clamp")
    dqn = study.dqn
    assert (dqn.learning_rate, dqn.batch_size, dqn.gamma, dqn.hidden) == (0.0071, 16, 0.98, (64, 64))
    assert (dqn.exploration_fraction, dqn.exploration_initial_eps, dqn.exploration_final_eps) == (0.35, 1.0, 0.05)
    assert (dqn.train_frequency, dqn.target_interval, dqn.learning_starts, dqn.max_grad_norm) == (4, 10_000, 100, 10.0)
    assert make_algorithm(study).iterations == 250_000


def test_population_is_the_product_of_the_axes():
    study = parse_study(SMALL, "small", {"axes.learning_rate": [0.01, 0.001, 0.1], "axes.reward": ["A", "U"]})
    agent_ids = make_agent_ids(study)
    assert len(agent_ids) == 2 * 2 * 3 * 2
    assert list(agent_ids[0]) == ["seed", "powered", "connected", "learning_rate", "reward"]
    agents = make_agents(study)
    assert_array_equal(agents.hyper.learning_rate, np.float32([agent["learning_rate"] for agent in agent_ids]))
    assert_array_equal(agents.scenario.layout.has_power.sum(axis=1), [agent["powered"] for agent in agent_ids])
    assert_array_equal(agents.scenario.reward.weights[0], [1, 0, 0, 0, 0, 0, 0, 0])
    assert_array_equal(agents.scenario.reward.weights[1], [0, 1, 0, 0, 0, 0, 0, 0])
    chex.assert_tree_shape_prefix(agents, (24,))


@pytest.mark.slow
def test_an_agent_does_not_depend_on_the_other_agents():
    few, many = parse_study(SMALL, "x"), parse_study(SMALL, "x", {"axes.powered": [12, 8, 4], "axes.seeds": [7, 1]})
    all_few, all_many = make_agent_ids(few), make_agent_ids(many)
    shared = [agent_id for agent_id in all_few if agent_id in all_many]
    assert len(shared) == 2  # seed 1, powered 8 and 4
    rows_few, rows_many = ([ids.index(agent_id) for agent_id in shared] for ids in (all_few, all_many))
    for make in (make_agents, validation_keys, evaluation_keys):
        in_few = jax.tree.map(lambda leaf: leaf[np.array(rows_few)], make(few))
        in_many = jax.tree.map(lambda leaf: leaf[np.array(rows_many)], make(many))
        chex.assert_trees_all_equal(in_few, in_many)


def test_draws_for_training_validation_and_evaluation_are_different():
    study = parse_study(SMALL, "x")
    training, validation, evaluation = make_agents(study).key, validation_keys(study), evaluation_keys(study)
    assert evaluation.shape == (4, 33)
    keys = np.concatenate(
        [jax.random.key_data(keys).reshape(-1, 2) for keys in (training, validation, evaluation[:, :-1])]
    )
    assert len(np.unique(keys, axis=0)) == len(keys)
    fixed = jax.random.key_data(evaluation[:, -1])
    assert len(np.unique(fixed, axis=0)) == 1


def test_scenario_parameters_and_devices_are_settings():
    study = parse_study(
        SMALL, "x", {"params.n_devices": 20, "params.region_m": [400.0, 300.0], "axes.uav_speed_m_s": [5, 10]}
    )
    agents = make_agents(study)
    assert agents.scenario.layout.position.shape == (8, 20, 2)
    assert agents.scenario.layout.position[..., 1].max() <= 300
    assert_array_equal(agents.scenario.params.uav_speed_m_s, [5, 10] * 4)
    assert agents.scenario.params.uav_speed_m_s.dtype == np.float32  # although the file has whole numbers


BAD = [
    ({"colour": "red"}, "bad.toml: colour is not a setting"),
    ({"dqn.gama": 0.9}, "bad.toml: dqn.gama is not a setting; did you mean 'gamma'?"),
    ({"steps": "many"}, "bad.toml: steps is 'many'; it should be a whole number"),
    ({"steps": 0}, "bad.toml: steps is 0; it should be greater than or equal to 1"),
    ({"steps": 1.5}, "bad.toml: steps is 1.5; it should be a whole number"),
    ({"dqn.learning_rate": float("nan")}, "bad.toml: dqn.learning_rate is nan; it should be a finite number"),
    ({"dqn.learning_rate": -0.1}, "bad.toml: dqn.learning_rate is -0.1; it should be greater than 0"),
    ({"dqn.train_frequency": 0}, "bad.toml: dqn.train_frequency is 0"),
    ({"dqn": 3}, "bad.toml: dqn is 3; it should be"),
    (
        {"params.uav_flying_power_w": -150.0},
        "bad.toml: params.uav_flying_power_w is -150.0; it should be greater than or",
    ),
    ({"params.n_devices": 1001}, "bad.toml: params.n_devices is 1001; it should be less than or equal to 1000"),
    (
        {"params.device_battery_range_j": [8e4, 5e4]},
        "bad.toml: params.device_battery_range_j is [80000.0, 50000.0]; give",
    ),
    ({"axes.powered": [13]}, "bad.toml: axes.powered has 13; give whole numbers from 0 to 12, the number of devices"),
    ({"axes.connected": [-1]}, "bad.toml: axes.connected has -1; give whole numbers from 0 to 12"),
    ({"axes.connected": [True]}, "bad.toml: axes.connected has True; give whole numbers"),
    ({"axes.powered": []}, "bad.toml: axes.powered is empty; give at least one value"),
    ({"axes.powered": [4, 4]}, "bad.toml: axes.powered repeats a value"),
    ({"axes.powered": [[4]]}, "bad.toml: axes.powered has [4]; give whole numbers"),
    ({"steps": 3_000_000_000}, "bad.toml: steps is 3000000000; it should be less than or equal to 2000000000"),
    (
        {"steps": 2_000_000_000, "algorithm": "ppo", "ppo.batch_size": 8},
        "bad.toml: ppo.n_epochs is 10; with batch_size = 8 and steps = 2,000,000,000, there are 2,500,001,280 updates; there "
        "can be 2,147,483,647; lower n_epochs or steps, or raise batch_size",
    ),
    ({"axes.powered": 8}, "bad.toml: axes.powered is 8; give a list"),
    ({"axes.seeds": 0}, "bad.toml: axes.seeds is 0; give at least 1 seed"),
    ({"axes.seeds": [-3]}, "bad.toml: axes.seeds has -3"),
    ({"axes.learning_rate": [float("nan")]}, "bad.toml: axes.learning_rate has nan; it should be a finite number"),
    ({"axes.learning_rates": [0.1]}, "bad.toml: axes.learning_rates is not an axis; did you mean 'learning_rate'?"),
    ({"axes.batch_size": [8, 16]}, "bad.toml: axes.batch_size is not an axis"),
    ({"axes.reward": ["A", "B+C"]}, "bad.toml: axes.reward is 'B+C', which is not a reward"),
    ({"reward": "U+log(A/0)"}, "bad.toml: reward is 'U+log(A/0)', which is not a reward; did you mean 'U+log(A/O)'?"),
    ({"reward": {"Q": 1.0}}, "bad.toml: reward has the term 'Q', which is not one"),
    ({"guard": "none"}, "bad.toml: guard is 'none'; it should be 'clamp' or 'log1p'"),
    ({"algorithm": "sarsa"}, "bad.toml: algorithm is 'sarsa'; it should be 'dqn', 'pqn', 'ppo', 'a2c' or 'none'"),
    ({"axes.algorithm": ["dqn", "sarsa"]}, "bad.toml: axes.algorithm has 'sarsa'; known: dqn, pqn, ppo, a2c"),
    ({"axes.algorithm": "dqn"}, "bad.toml: axes.algorithm is 'dqn'; give a list"),
    ({"algorithm": "none", "axes.algorithm": ["dqn"]}, "bad.toml: axes.algorithm is given, but algorithm is 'none'"),
    ({"dqn.clip_range": 0.1}, "bad.toml: dqn.clip_range is not a setting; "),
    (
        {"axes.clip_range": [0.1, 0.2]},
        "bad.toml: axes.clip_range is not a hyperparameter of dqn, which has learning_rate, learning_rate_final, gamma",
    ),
    (
        {"axes.tau": [0.1], "axes.algorithm": ["ppo", "dqn"]},
        "bad.toml: axes.tau is not a hyperparameter of ppo, which has learning_rate, gamma, gae_lambda, ent_coef",
    ),
    ({"ppo.clip_range": 0.1}, "bad.toml: ppo has settings, but the study trains dqn; leave them out"),
    (
        {"algorithm": "ppo", "ppo.batch_size": 100},
        "bad.toml: ppo.batch_size is 100; it should divide n_steps * n_envs = 2048",
    ),
    (
        {"algorithm": "pqn", "pqn.batch_size": 100},
        "bad.toml: pqn.batch_size is 100; it should divide n_steps * n_envs = 2048",
    ),
    (
        {"algorithm": "pqn", "pqn.guide": "newest-first"},
        "bad.toml: pqn.guide is 'newest-first'; it should be 'none', 'round-robin', 'oldest-first'",
    ),
    ({"algorithm": "a2c", "a2c.gae_lambda": 1.5}, "bad.toml: a2c.gae_lambda is 1.5; it should be less than or equal"),
    ({"dqn.n_step": 0}, "bad.toml: dqn.n_step is 0; it should be greater than or equal to 1"),
    ({"dqn.tau": 0.0}, "bad.toml: dqn.tau is 0.0; it should be greater than 0"),
    ({"axes.cells": [[8, 8]]}, "bad.toml: axes.cells is given, and axes.powered or axes.connected too; give"),
    (
        {"evaluation.planners": ["oracle"]},
        "bad.toml: evaluation.planners: item 1 is 'oracle'; it should be 'rollout', 'beam'",
    ),
    (
        {"algorithm": "none", "evaluation.baselines": [], "evaluation.planners": []},
        "bad.toml: algorithm is 'none' and evaluation has neither baselines nor planners; name one to evaluate",
    ),
    (
        {"params.end": "horizon", "evaluation.planners": []},
        "bad.toml: params.end is 'horizon', and algorithm is 'dqn', whose replay of the paper's observation holds no ages",
    ),
    ({"evaluation.beam_width": 0}, "bad.toml: evaluation.beam_width is 0; it should be greater than or equal to 1"),
    (
        {"evaluation.draws": 4, "evaluation.planner_draws": 5},
        "bad.toml: evaluation.planner_draws is 5; give at most eval",
    ),
    ({"evaluation.planner_draws": 0}, "bad.toml: evaluation.planner_draws is 0; it should be greater"),
    ({"name": "../x"}, "bad.toml: name is '../x'"),
]


def test_a_dqn_with_the_full_observation_takes_a_horizon():
    changes = {"params.end": "horizon", "evaluation.planners": [], "dqn.observation": "full"}
    assert load_study("table5", changes).params.end == "horizon"


@pytest.mark.parametrize(("change", "message"), BAD, ids=[message[10:50] for _, message in BAD])
def test_bad_setting_is_refused_in_one_line(change, message):
    with pytest.raises(StudyError) as error:
        parse_study(SMALL, "bad.toml", change)
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def test_missing_axis():
    with pytest.raises(StudyError, match=r"x: axes.connected is missing"):
        parse_study("[axes]\npowered = [4]\nseeds = 1", "x")
    with pytest.raises(StudyError, match="x: axes is missing"):
        parse_study("steps = 10", "x")


def test_not_toml_and_missing_file(tmp_path):
    with pytest.raises(StudyError, match="x: not TOML"):
        parse_study("steps = = 3", "x")
    with pytest.raises(StudyError, match=r"neither a study file nor a shipped study; did you mean 'table5'"):
        load_study("tabel5")
    with pytest.raises(StudyError, match="no such file"):
        load_study(tmp_path / "none.toml")
    (tmp_path / "latin.toml").write_bytes(b"name = '\xe9'")
    with pytest.raises(StudyError, match="cannot be read"):
        load_study(tmp_path / "latin.toml")


CELLS = "[axes]\ncells = [[6, 6], [10, 8]]\nseeds = [0, 2]\n"


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ("[[6, 13]]", "axes.cells has 13; give whole numbers from 0 to 12"),
        ("[[6]]", r"axes.cells has \[6\]; give pairs \[powered, connected\]"),
        ("[[6, 6], [6, 6]]", "axes.cells repeats a value"),
        ("3", "axes.cells is 3; give a list"),
    ],
)
def test_bad_cells(cells, message):
    with pytest.raises(StudyError, match=message):
        parse_study(f"[axes]\nseeds = 1\ncells = {cells}", "x")


def test_cells_are_pairs():
    study = parse_study(CELLS, "x")
    assert [tuple(agent_id.values()) for agent_id in make_agent_ids(study)] == [
        (0, 6, 6), (0, 10, 8), (2, 6, 6), (2, 10, 8)
    ]  # fmt: skip
    assert n_agents(study) == 4
    assert parse_study(study_toml(study), "again") == study


def test_a_study_of_several_algorithms_is_split_by_algorithm():
    study = parse_study(CELLS, "x", {"axes.algorithm": ["a2c", "dqn"], "axes.gamma": [0.9, 0.98], "a2c.vf_coef": 0.3})
    assert n_agents(study) == len(make_agent_ids(study)) == 16
    assert [agent_id["algorithm"] for agent_id in make_agent_ids(study)] == ["a2c"] * 8 + ["dqn"] * 8
    a2c, dqn = (part.study for part in split_study(study))
    assert [part.name for part in split_study(study)] == ["a2c", "dqn"]
    assert (make_algorithm(a2c).name, make_algorithm(dqn).name) == ("a2c", "dqn")
    agents, others = make_agents(a2c), make_agents(dqn)
    assert_array_equal(agents.hyper.gamma, np.tile(np.float32([0.9, 0.98]), 4))
    assert_allclose(agents.hyper.vf_coef, 0.3)
    # layouts and keys are the same under every algorithm
    assert_array_equal(agents.scenario.layout.position, others.scenario.layout.position)
    assert_array_equal(jax.random.key_data(agents.key), jax.random.key_data(others.key))
    assert parse_study(study_toml(study), "again") == study


def test_a_reward_without_ages_in_logarithms_has_one_guard():
    rewards = ["A", "log A", "log M", {"log O": -1.0}]
    study = parse_study(CELLS, "x", {"axes.reward": rewards[:3], "axes.guard": ["log1p", "clamp"]})
    pairs = {(agent_id["reward"], agent_id["guard"]) for agent_id in make_agent_ids(study)}
    assert pairs == {("A", "log1p"), ("log A", "log1p"), ("log A", "clamp"), ("log M", "log1p")}
    assert n_agents(study) == len(make_agent_ids(study)) == 4 * 4
    assert not make_agents(study).scenario.reward.log1p.all()


def test_table6_is_the_papers_table():
    study = load_study("table6")
    assert n_agents(study) == 3 * 3 * 5 * (11 + 4)
    assert study.axes["reward"] == list(REWARDS)
    axes = ("reward", "powered", "connected", "algorithm")
    assert {tuple(agent_id[axis] for axis in axes) for agent_id in make_agent_ids(study)} == set(TABLE6)
    assert max(TABLE6.values()) == 30  # U+log(A/O), 10 powered, 8 connected, DQN


def test_planners_are_evaluated_on_all_draws_if_they_are_fewer_than_by_default():
    study = load_study("table5", {"evaluation.draws": 3})
    assert study.evaluation.planner_draws == 3
    assert parse_study(study_toml(study), "again") == study
    assert load_study("table5", {"evaluation.draws": 9}).evaluation.planner_draws == 8

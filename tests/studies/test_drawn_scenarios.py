"""Studies of drawn scenarios: their files, their evaluation, and their policies for any number of devices."""

from functools import partial

import chex
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.experiments.scripts import run as run_script
from tests.populations import stack, take
from uavmec_jax.agents import ppo, pqn
from uavmec_jax.agents.algorithm import AGENTS_AXIS
from uavmec_jax.agents.collect_rollout import collect_rollout
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.errors import PolicyError, StudyError
from uavmec_jax.runs.run import run_study
from uavmec_jax.scenarios.distribution import out_of_distribution
from uavmec_jax.scenarios.policies import load_policy
from uavmec_jax.studies.population import evaluation_keys, make_agent_ids, make_agents, validation_keys
from uavmec_jax.studies.study import load_study, parse_study, study_toml

TOML = """
algorithm = "ppo"
steps = 64
reward = {}
slot_reward = 0.1
[axes]
seeds = 2
[scenarios]
devices = [2, 6]
typical_devices = 5
typical_least = 2
[params]
n_devices = 6
[ppo]
observation = "full"
hidden = [8]
n_envs = 4
n_steps = 8
batch_size = 16
n_epochs = 1
[evaluation]
draws = 6
validate_every = 32
validation_draws = 4
baselines = ["oldest-first"]
planners = []
"""


def study_of(text=TOML, **overrides):
    return parse_study(text, "mine.toml", overrides)


def test_all_agents_are_evaluated_on_the_same_scenarios():
    study = study_of()
    assert make_agent_ids(study) == [{"seed": 0, "scenarios": "drawn"}, {"seed": 1, "scenarios": "drawn"}]
    for keys in (validation_keys(study), evaluation_keys(study)):
        first, second = jax.random.key_data(keys)
        assert_array_equal(first, second)
    first, second = jax.random.key_data(make_agents(study).key)
    assert (first != second).any()


def test_study_round_trip():
    study = study_of()
    assert parse_study(study_toml(study), "again.toml") == study
    assert load_study("generalist").scenarios.places == ("albany", "round_lake")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "devices = [2, 6]",
            "devices = [2, 7]",
            "scenarios.devices is [2.0, 7.0]; give [low, high] with 2 <= low <= high <= 6",
        ),
        (
            "devices = [2, 6]",
            "devices = [2, 6]\npowered = [0.5, 1.2]",
            "scenarios.powered is [0.5, 1.2]; give [low, high] with 0 <= low",
        ),
        (
            "devices = [2, 6]",
            "devices = [2, 6]\nregion_m = [0.0, 9.0]",
            "scenarios.region_m is [0.0, 9.0]; give [low, high] with 0 < low",
        ),
        ("devices = [2, 6]", "devices = [2, 6]\nuav_factor = [2.0, 1.0]", "scenarios.uav_factor is [2.0, 1.0]"),
        ("typical_least = 2", "typical_least = 9", "scenarios.typical_least is 9; typical_devices is the most"),
        ("typical_least = 2", "typical = 1.5", "scenarios.typical is 1.5"),
        ("typical_least = 2", "devises = 1", "did you mean 'devices'?"),
        (
            "typical_devices = 5",
            "typical_devices = 7",
            "scenarios.typical_devices is 7; params.n_devices, 6, is the most",
        ),
        ("seeds = 2", "seeds = 2\npowered = [4]", "axes.powered is given, and scenarios too"),
        ("steps = 64", 'steps = 64\nplace = "albany"', "place is given, and scenarios too"),
        ('observation = "full"', 'observation = "all"', "ppo.observation is 'all'"),
    ],
)
def test_bad_setting_is_refused_in_one_line(old, new, words):
    text = TOML.replace(old, new)
    with pytest.raises(StudyError) as error:
        study_of(text)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def text_of(name):
    text = TOML.replace("ppo", name)
    if name == "dqn":
        text = text.replace("n_envs = 4\nn_steps = 8\n", "").replace("n_epochs = 1\n", "learning_starts = 8\n")
    return text


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo", "pqn"])
def test_an_episode_that_ends_is_followed_by_one_in_a_fresh_scenario(name):
    """Where an episode has ended, the layout is another one; elsewhere it stays."""
    algorithm, spec_class = {"ppo": (ppo, ppo.PPOSpec), "pqn": (pqn, pqn.PQNSpec)}[name]
    collect_samples = {"ppo": collect_rollout, "pqn": pqn.collect_samples}[name]
    agent = take(make_agents(study_of(TOML.replace("ppo", name))), 0)
    spec = spec_class(hidden=(8,), observation="full", n_envs=16, n_steps=1, n_devices=6, batch_size=16)
    state = algorithm.algorithm(spec).init(agent)
    collect = jax.jit(jax.vmap(partial(collect_samples, spec, agent), axis_name=AGENTS_AXIS))
    some_ended = False
    for number in range(16):
        after, samples = take(collect(stack([state]), jax.random.key(number)[None]), 0)
        ended = np.asarray(after.env_states.slot) == 0
        before_layout, after_layout = state.scenarios.layout, after.scenarios.layout
        assert_array_equal(ended, np.any(before_layout.position != after_layout.position, axis=(1, 2)))
        chex.assert_tree_all_finite(samples)
        assert np.take_along_axis(np.asarray(before_layout.present), np.asarray(samples.action)[:, None], 1).all()
        some_ended |= ended.any()
        state = after
    assert some_ended


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "observation"),
    [
        ("dqn", "full"),
        pytest.param("dqn", "paper", marks=pytest.mark.full),
        pytest.param("pqn", "full", marks=pytest.mark.full),
        ("pqn", "paper"),
    ],
)
def test_q_learning_on_drawn_scenarios(tmp_path, name, observation):
    text = text_of(name).replace('observation = "full"', f'observation = "{observation}"')
    results = run_study(study_of(text), tmp_path / "run")
    assert_array_equal(results.agents["diverged_at"], -1)
    policy = load_policy(tmp_path / "run", seed=1)
    assert policy.algorithm == name
    for n in (3, 12) if observation == "full" else (6,):
        params = Params(n_devices=n)
        layout = sample_layout(jax.random.key(n), params, 1, 1)
        assert 0 <= int(policy(params, layout, initial_state(params, layout))) < n


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawn") / "run"
    return run_study(study_of(), folder), folder


@pytest.mark.slow
def test_results_of_a_run(run):
    results, _ = run
    assert results.run["complete"]
    assert results.agents["scenarios"].tolist() == ["drawn", "drawn"]
    assert results.evaluation["best/lifetime"].shape == (2, 7)
    oldest = results.evaluation["oldest_first/lifetime"]
    assert_array_equal(oldest[0], oldest[1])
    assert (results.agents["best_validation"] <= results.agents["best_validation"].max()).all()
    assert results.cells()["seeds"].tolist() == [2]


@pytest.mark.slow
def test_its_policies_take_any_number_of_devices(run):
    _, folder = run
    with pytest.raises(PolicyError, match="they differ in seed"):
        load_policy(folder)
    policy = load_policy(folder, seed=1)
    for n in (3, 12):
        params = Params(n_devices=n)
        layout = sample_layout(jax.random.key(n), params, 1, 1)
        assert 0 <= int(policy(params, layout, initial_state(params, layout))) < n


def test_quantities_outside_the_training_distribution_are_named():
    study = load_study("generalist")
    scenarios, trained = study.scenarios.model_dump(), study.params.model_dump()
    params = Params()
    layout = sample_layout(jax.random.key(0), params, 8, 8)
    assert out_of_distribution(scenarios, trained, params, layout) == []
    far = Params(n_devices=40, data_age_limit_slots=20, uav_speed_m_s=9.0, region_m=(9000.0, 9000.0), end="horizon")
    lines = out_of_distribution(scenarios, trained, far, sample_layout(jax.random.key(0), far, 8, 8))
    quantities = [line.split(":")[0] for line in lines]
    assert quantities == ["devices", "extent in m", "the UAV's speed in m/s", "end", "data_age_limit_slots"]
    assert lines[0] == "devices: 40; it was trained on 4 to 16"
    assert lines[-1] == "data_age_limit_slots: 20; it was trained on 10"


@pytest.mark.slow
def test_training_on_drawn_scenarios_with_the_papers_observation():
    """Drawn scenarios do not need the full observation: a network on the paper's takes padded layouts of one size."""
    study = study_of(TOML.replace('observation = "full"', 'observation = "paper"'), **{"axes.seeds": 1})
    results = run_study(study)
    assert_allclose(results.agents["diverged_at"], -1)


@pytest.mark.slow
def test_its_best_policy_is_shipped(run, tmp_path):
    """The script that ships the generalist takes a finished run as it is, here a tiny one."""
    results, folder = run
    out = run_script("ship_generalist.py", "--run", folder, "--into", tmp_path / "mine.npz")
    assert "mine.npz" in out
    shipped = load_policy(tmp_path / "mine.npz")
    assert shipped.n_devices is None
    assert shipped.trained_on["seed"] == results.agents["best_validation"].idxmax()

"""Saved policies: they act as they were trained, and files that were altered are refused in one line."""

import itertools
import json
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import traverse_util
from numpy.testing import assert_allclose, assert_array_equal

import uavmec_jax as um
from tests.runs.test_run import TOML as TINY
from uavmec_jax.agents import dqn, ppo
from uavmec_jax.env.observation import observe
from uavmec_jax.errors import PolicyError
from uavmec_jax.planning.heuristics import FLEET_HEURISTICS, HEURISTICS
from uavmec_jax.runs.run import run_study
from uavmec_jax.scenarios.policies import TrainedPolicy, load_policy
from uavmec_jax.scenarios.policy_files import PolicyCollection, read_policies, write_policies
from uavmec_jax.scenarios.seeds import held_out_draws, layout_for_seed
from uavmec_jax.studies.schema import DQNSettings, PPOSettings
from uavmec_jax.studies.study import parse_study

AGENT = {"algorithm": "dqn", "powered": 12, "connected": 4, "seed": 1}


def collection_of(name, network, settings, agents):
    """Make a collection with random weights, best and last."""
    make = jax.jit(jax.vmap(lambda key: network.init(key, jnp.zeros((1, 24)))))
    kinds = {kind: make(jax.random.split(jax.random.key(i), len(agents))) for i, kind in enumerate(("best", "last"))}
    weights = traverse_util.flatten_dict({name: kinds}, sep="/")
    return PolicyCollection(
        settings={name: settings.model_dump(mode="json")},
        n_devices=12,
        agents={name: agents},
        weights={key: np.asarray(leaf) for key, leaf in weights.items()},
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run of eight DQN agents, with its weights only."""
    directory = tmp_path_factory.mktemp("run")
    axes = ("seed", "powered", "connected")
    agents = [dict(zip(axes, values, strict=True)) for values in itertools.product((0, 1), (12, 4), (12, 4))]
    write_policies(
        directory / "weights.npz",
        collection_of("dqn", dqn.DQNSpec(hidden=(16,)).network, DQNSettings(hidden=(16,)), agents),
    )
    return directory


@pytest.fixture(scope="module")
def ppo_policy():
    """A PPO policy on ages divided by ten."""
    agents = [{"seed": seed, "powered": 8, "connected": 8} for seed in range(3)]
    settings = PPOSettings(hidden=(16,), age_scale=0.1)
    return TrainedPolicy.of(collection_of("ppo", ppo.PPOSpec(hidden=(16,)).network, settings, agents), "ppo", 2, "best")


def test_a_policy_that_is_loaded_again_is_the_same_one(run, tmp_path):
    """So its programs are compiled once, however often it is loaded, and wherever from."""
    chosen = {"powered": 4, "connected": 12, "seed": 1}
    policy = load_policy(run, **chosen)
    assert load_policy(run, **chosen) is load_policy(run / "weights.npz", **chosen) is policy
    policy.save(tmp_path / "alone.npz")
    assert load_policy(tmp_path / "alone.npz") is policy
    assert load_policy(run, powered=4, connected=12, seed=0) is not policy
    assert load_policy("rollout") is load_policy("rollout")
    other = dict(policy.collection.weights)
    name = next(iter(other))
    other[name] = other[name] + np.float32(1)
    write_policies(tmp_path / "alone.npz", replace(policy.collection, weights=other))
    assert load_policy(tmp_path / "alone.npz") is not policy


@pytest.mark.slow
def test_policy_of_a_run_has_the_lifetime_in_its_table(tmp_path):
    results = run_study(parse_study(TINY, "tiny"), tmp_path / "run")
    policy = load_policy(tmp_path / "run", powered=4, connected=12, seed=1)
    assert policy.trained_on == {"seed": 1, "powered": 4, "connected": 12}
    layout = layout_for_seed(1, um.Params(), 4, 12)
    episodes = jax.jit(lambda keys: um.rollouts(policy, um.Params(), layout, keys))(held_out_draws(1, 4, 12, 5))
    row = results.agents.query("powered == 4 and connected == 12 and seed == 1")
    assert_allclose(episodes.length.mean(), row["best_lifetime"].item(), rtol=1e-6)


@pytest.mark.parametrize("kind", ["dqn", "ppo"])
def test_batched_states_and_numpy_observations(run, ppo_policy, kind):
    policy = ppo_policy if kind == "ppo" else load_policy(run, "last", powered=12, connected=4, seed=0)
    layout = layout_for_seed(0, um.Params(), 12, 4)
    state = um.initial_state(um.Params(), layout)
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (3, 2, *leaf.shape)), state)
    states = states.replace(age=jax.random.randint(jax.random.key(0), (3, 2, 12), 0, 10))
    actions = policy(um.Params(), layout, states)
    assert actions.shape == (3, 2)
    alone = jax.vmap(jax.vmap(lambda state: policy(um.Params(), layout, state)))(states)
    assert_array_equal(actions, alone)
    assert_array_equal(policy.act(np.asarray(observe(um.Params(), layout, states))), actions)
    assert policy.act(np.asarray(observe(um.Params(), layout, state))).shape == ()


def test_policy_saved_on_its_own(ppo_policy, tmp_path):
    ppo_policy.save(tmp_path / "mine.npz")
    again = load_policy(tmp_path / "mine.npz")
    assert isinstance(again, TrainedPolicy)
    assert again.algorithm == "ppo"
    assert again.trained_on == {"seed": 2, "powered": 8, "connected": 8}
    observations = np.random.default_rng(0).random((50, 24), np.float32) * np.repeat([1, 11], 12)
    assert_array_equal(again.act(observations), ppo_policy.act(observations))
    assert len(set(again.act(observations).tolist())) > 1


def test_policies_by_name():
    assert load_policy("oldest-first") is HEURISTICS["oldest-first"]
    assert callable(load_policy("rollout"))
    with pytest.raises(PolicyError, match="did you mean 'oldest-first'"):
        load_policy("oldest-frist")


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({}, "there are 8 agents; say which: they differ in connected, powered, seed"),
        ({"powered": 12, "seed": 1}, "2 agents have powered=12, seed=1; say which: they differ in connected"),
        ({"powered": 8}, "none of the 8 agents has powered=8"),
        ({"colour": 1}, "'colour' is not an axis of the agents; they have algorithm, connected, powered, seed"),
    ],
)
def test_ambiguous_or_missing_agent(run, axes, message):
    with pytest.raises(PolicyError) as error:
        load_policy(run, **axes)
    assert str(error.value) == f"{run / 'weights.npz'}: {message}"


def test_missing_weights(run):
    with pytest.raises(PolicyError, match="there are no 'worst' weights of 'dqn'; there are best and last of dqn"):
        um.load_policy(run, "worst", **AGENT)


@pytest.mark.parametrize("shape", [(), (23,), (24, 3)])
def test_observation_of_another_shape(run, shape):
    policy = load_policy(run, **AGENT)
    with pytest.raises(PolicyError) as error:
        policy.act(np.zeros(shape))
    assert str(error.value) == f"the observation has the shape {shape}; it should be (24,) or (..., 24)"


def test_observation_without_numbers_and_another_number_of_devices(run):
    policy = load_policy(run, **AGENT)
    with pytest.raises(PolicyError, match="is not an array of numbers"):
        policy.act(["a", "b"])
    params = um.Params(n_devices=5)
    layout = layout_for_seed(0, params, 2, 2)
    with pytest.raises(PolicyError, match="was trained for 12 devices; the layout has 5"):
        policy(params, layout, um.initial_state(params, layout))


def rewrite(source, target, change):
    """Copy a policy file with its header or arrays changed, but with the old SHA-256."""
    with np.load(source) as archive:
        arrays = dict(archive)
    facts = json.loads(str(arrays.pop("header")))
    change(facts, arrays)
    np.savez_compressed(target, header=np.array(json.dumps(facts)), **arrays)


def flip_weight(facts, arrays):
    arrays["dqn/best/params/TorchDense_0/kernel"][0, 0, 0] += 1


def raise_schema(facts, arrays):
    facts["schema"] = 7


def change_setting(facts, arrays):
    facts["settings"]["dqn"]["age_scale"] = 0.5


ALTERED = [
    (flip_weight, "was altered: its contents do not fit their SHA-256"),
    (change_setting, "was altered: its contents do not fit their SHA-256"),
    (raise_schema, "schema is 7; this version reads 1"),
]


@pytest.mark.parametrize(("change", "message"), ALTERED, ids=[change.__name__ for change, _ in ALTERED])
def test_altered_file_is_refused(run, tmp_path, change, message):
    path = tmp_path / "mine.npz"
    load_policy(run, **AGENT).save(path)
    rewrite(path, tmp_path / "other.npz", change)
    with pytest.raises(PolicyError) as error:
        load_policy(tmp_path / "other.npz")
    assert str(error.value) == f"{tmp_path / 'other.npz'}: {message}"


def test_settings_newer_than_the_file_have_their_defaults(run, tmp_path):
    stored = read_policies(run / "weights.npz")
    older = {name: value for name, value in stored.settings["dqn"].items() if name not in ("layer_norm", "gap")}
    write_policies(tmp_path / "old.npz", replace(stored, settings={"dqn": older}))
    observations = np.linspace(0, 1, 240, dtype=np.float32).reshape(10, 24)
    old, new = load_policy(tmp_path / "old.npz", **AGENT), load_policy(run, **AGENT)
    assert_array_equal(old.act(observations), new.act(observations))


def test_weights_that_are_not_finite_are_refused(run, tmp_path):
    collection = read_policies(run / "weights.npz")
    key = "dqn/best/params/TorchDense_0/kernel"
    weights = dict(collection.weights) | {key: collection.weights[key].copy()}
    weights[key][5, 0, 0] = np.nan  # seed 1, powered 12, connected 4
    write_policies(tmp_path / "weights.npz", replace(collection, weights=weights))
    with pytest.raises(PolicyError) as error:
        load_policy(tmp_path, **AGENT)
    assert str(error.value) == (
        f"{tmp_path / 'weights.npz'}: the best weights of dqn are not finite: training diverged"
    )
    assert load_policy(tmp_path, "last", **AGENT).n_devices == 12
    assert load_policy(tmp_path, **AGENT | {"seed": 0}).n_devices == 12


def test_damaged_and_foreign_files_are_refused(run, tmp_path):
    path = tmp_path / "mine.npz"
    load_policy(run, **AGENT).save(path)
    whole = path.read_bytes()
    for broken in (whole[:-40], whole[: len(whole) // 2], b"", b"not a zip"):
        path.write_bytes(broken)
        with pytest.raises(PolicyError, match=r"mine\.npz: cannot be read") as error:
            load_policy(path)
        assert "\n" not in str(error.value)
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(whole), 30):  # a flipped bit is noticed, or changes no weight
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        try:
            policy = load_policy(path)
        except PolicyError:
            continue
        path.write_bytes(whole)
        chex.assert_trees_all_equal(policy.collection.weights, load_policy(path).collection.weights)
    np.savez(path, x=np.zeros(3))
    with pytest.raises(PolicyError, match="is not a file of policies"):
        load_policy(path)
    with pytest.raises(PolicyError, match=r"none\.npz: cannot be read"):
        load_policy(tmp_path / "none.npz")


@pytest.mark.slow
def test_a_trained_policy_lifted_to_a_fleet(run):
    """One UAV with a depot and three UAVs decide by the policy; without any depot, the first one does as if it were alone."""
    policy = load_policy(run, seed=1, powered=12, connected=4)
    params, layout = um.Params(), layout_for_seed(1, um.Params(), 12, 4)
    alone = policy(params, layout, um.initial_state(params, layout))
    three = layout.replace(fleet=um.load_scenario(uavs=3).layout.fleet)
    state = um.initial_state(params, three)
    action = jax.jit(policy)(params, three, state)
    assert action.shape == (3,)
    assert action[0] == alone
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    assert_array_equal(policy(params, three, batch), [action, action])
    depot = layout.replace(depots=um.load_scenario(depot="swap").layout.depots)
    low = um.initial_state(params, depot).replace(uav_energy=jnp.array([1000.0]))
    assert policy(params, depot, low) == 12  # it stands at the depot
    assert policy.fleet_warnings(layout) == []
    alone = "the policy was trained for one UAV without depots"
    assert policy.fleet_warnings(depot) == [f"{alone}; a rule sends UAVs to depots"]
    assert policy.fleet_warnings(three) == [f"{alone}; here the UAVs decide one after another"]


def test_rules_of_fleets_have_names():
    assert load_policy("split-deadline") is FLEET_HEURISTICS["split-deadline"]
    with pytest.raises(PolicyError, match="did you mean 'split-deadline'"):
        load_policy("split-deadlin")


def test_a_trained_policy_does_not_visit_dead_devices(ppo_policy):
    params = um.Params(end="horizon")
    layout = layout_for_seed(0, params, 4, 4)
    state = um.initial_state(params, layout)
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (12, *leaf.shape)), state)
    dead = ~np.eye(12, dtype=bool)  # all but one
    states = states.replace(failed_at=jnp.where(dead, 1, -1), battery=jnp.where(dead, 0.0, states.battery))
    assert_array_equal(ppo_policy(params, layout, states), np.arange(12))

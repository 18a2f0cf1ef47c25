"""gymnax 1.0's own wrappers: uv run --no-default-groups --group gymnax pytest tests/clients -m clients -W default."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax import wrappers
from gymnax.environments import spaces
from numpy.testing import assert_array_equal

import uavmec_jax as um
from uavmec_jax.env.environment import UavMecEnv
from uavmec_jax.env.scenario import make_scenario
from uavmec_jax.interop import FiveValueEnv
from uavmec_jax.planning.observation import FEATURES, observe_devices

pytestmark = pytest.mark.clients

ENV = UavMecEnv()
PARAMS = ENV.default_params


def small_scenario():
    params = um.Params(n_devices=4)
    return make_scenario(um.sample_layout(jax.random.key(0), params, 2, 2), params)


def test_spaces():
    assert ENV.num_actions == ENV.action_space().n == ENV.action_space(PARAMS).n == 12
    assert ENV.action_space(small_scenario()).n == 4
    box = ENV.observation_space(PARAMS)
    assert_array_equal(box.high, np.repeat([1.0, 11.0], 12))
    assert_array_equal(box.low, np.zeros(24))
    assert (box.shape, box.dtype) == ((24,), np.float32)
    observation, state = ENV.reset(jax.random.key(0), PARAMS)
    for slot in range(30):
        assert box.contains(observation)
        observation, state, *_ = ENV.step(jax.random.key(slot), state, slot % 12, PARAMS)


def test_spaces_of_fleets_and_of_other_observations():
    params = um.Params(n_devices=4)
    layout = um.sample_layout(jax.random.key(0), params, 2, 2).replace(
        fleet=um.env.make_fleet(params, 2), depots=um.env.make_depots([(0.0, 0.0)], "swap")
    )
    scenario = make_scenario(layout, params)
    actions = ENV.action_space(scenario)
    assert [space.n for space in actions.spaces] == [5, 5]
    _, state = ENV.reset(jax.random.key(0), scenario)
    _, state, *_ = ENV.step(jax.random.key(0), state, jnp.stack(actions.sample(jax.random.key(1))), scenario)
    assert state.slot == 1

    features, mask = UavMecEnv(observation_fn=observe_devices).observation_space(PARAMS).spaces
    assert (features.shape, features.dtype, mask.shape) == ((12, len(FEATURES)), np.float32, (12,))
    assert_array_equal(features.high, np.inf)
    both = UavMecEnv(observation_fn=lambda params, layout, state: {"battery": state.battery, "age": state.age})
    assert list(both.observation_space(PARAMS).spaces) == ["age", "battery"]
    horizon = make_scenario(PARAMS.layout, um.Params(end="horizon"))
    assert_array_equal(ENV.observation_space(horizon).high, np.repeat([1.0, np.inf], 12))


def test_log_wrapper_and_flattened_observations():
    env = wrappers.LogWrapper(wrappers.FlattenObservationWrapper(ENV))
    assert env.num_actions == 12
    assert isinstance(env.observation_space(PARAMS), spaces.Box)
    _, plain = ENV.reset(jax.random.key(0), PARAMS)
    observation, state = env.reset(jax.random.key(0), PARAMS)
    total = 0.0
    for slot in range(40):
        key = jax.random.key(slot)
        observation, state, reward, terminated, truncated, info = env.step(key, state, 0, PARAMS)
        same, plain, other_reward, *_ = ENV.step(key, plain, 0, PARAMS)
        assert_array_equal(observation, same)
        assert reward == other_reward
        total += float(reward)
        if terminated | truncated:
            break
    assert info["returned_episode"]
    assert info["returned_episode_lengths"] == slot + 1
    assert float(info["returned_episode_returns"]) == pytest.approx(total, rel=1e-5)


def test_gymnasium_wrappers():
    env = wrappers.GymnaxToGymWrapper(ENV, PARAMS, seed=3)
    assert env.action_space == gymnasium.spaces.Discrete(12)
    observation, _ = env.reset(seed=1)
    for action in range(12):
        assert env.observation_space.contains(np.asarray(observation))
        observation, reward, terminated, truncated, _ = env.step(action)
        assert np.isfinite(reward)
        assert not truncated

    envs = wrappers.GymnaxToVectorGymWrapper(ENV, num_envs=3, params=PARAMS)
    observation, _ = envs.reset(seed=1)
    assert observation.shape == (3, 24)
    observation, reward, terminated, truncated, _ = envs.step(np.array([0, 1, 2]))
    assert observation.shape == (3, 24)
    assert reward.shape == terminated.shape == truncated.shape == (3,)
    assert ENV.step.__self__ is ENV  # the wrapper replaced the methods of its copy


def test_environments_with_the_same_observation_are_one_static_argument():
    assert UavMecEnv() == UavMecEnv()
    assert hash(UavMecEnv()) == hash(UavMecEnv())
    assert UavMecEnv() != UavMecEnv(observation_fn=observe_devices)


def test_five_values_have_the_same_spaces():
    env = FiveValueEnv()
    assert env.num_actions == env.action_space().n == env.action_space(env.default_params).n == 12
    assert_array_equal(env.observation_space(env.default_params).high, ENV.observation_space(PARAMS).high)
    assert_array_equal(env.observation_space().high, ENV.observation_space().high)

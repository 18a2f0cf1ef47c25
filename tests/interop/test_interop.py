"""The environment through the interfaces of other libraries."""

import sys

import chex
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.testing import assert_allclose, assert_array_equal

import uavmec_jax as um
from uavmec_jax.env.observation import observe
from uavmec_jax.env.scenario import draw_volumes, make_scenario
from uavmec_jax.interop import ENV_ID
from uavmec_jax.interop.five_values import FiveValueEnv
from uavmec_jax.interop.gymnasium_env import UavMecGymEnv
from uavmec_jax.interop.vector_env import UavMecVectorEnv


@pytest.fixture(scope="module")
def env():
    gym_env = gymnasium.make(ENV_ID, render_mode="rgb_array")
    yield gym_env
    gym_env.close()


def test_gymnasiums_checker_passes(env):
    check_env(env.unwrapped)


def test_step_is_the_transition(env):
    scenario = env.unwrapped.scenario
    observation, info = env.reset(seed=3)
    assert_allclose(observation, np.repeat([1.0, 0.0], 12), atol=1e-6)
    assert info == {}
    generator = np.random.default_rng(3)  # as Gymnasium seeds it
    state, step = um.initial_state(scenario.params, scenario.layout), jax.jit(um.transition)
    for slot in range(40):
        volumes = draw_volumes(scenario.params, jnp.asarray(generator.random(12, dtype=np.float32)))
        action = (5 * slot) % 12
        state, outcome = step(scenario.params, scenario.layout, state, action, volumes)
        observation, reward, terminated, truncated, info = env.step(action)
        assert_allclose(observation, observe(scenario.params, scenario.layout, state), rtol=1e-6)
        assert np.isfinite(reward)
        assert not truncated
        assert terminated == (outcome.cause != um.Cause.NONE)
        assert info["cause"] == um.Cause(int(outcome.cause)).name.lower()
        assert_array_equal(info["failed"], outcome.failed)
        assert_array_equal(info["served"], outcome.served)
        assert (info["length"], info["duration"]) == (state.slot, pytest.approx(float(outcome.duration)))
        if terminated:
            break
    assert terminated
    assert info["failed"].any()
    assert_allclose(info["first_failure"].sum(), 1.0, rtol=1e-6)


def test_the_time_limit_truncates():
    short = UavMecGymEnv(make_scenario(params=um.Params(max_slots=2)))
    short.reset(seed=0)
    assert [short.step(0)[2:4] for _ in range(2)] == [(False, False), (False, True)]


def test_render_draws_the_map(env):
    env.reset(seed=0)
    first = env.render()
    env.step(4)
    second = env.render()
    assert first.shape == second.shape == (480, 640, 3)
    assert first.dtype == np.uint8
    assert (first != second).any()
    assert UavMecGymEnv().render() is None
    with pytest.raises(ValueError, match="render_mode is 'human'; it should be None or 'rgb_array'"):
        UavMecGymEnv(render_mode="human")


def test_vector_environment_is_deterministic_and_resets_itself():
    envs = gymnasium.make_vec(ENV_ID, num_envs=4)
    first, _ = envs.reset(seed=1)
    assert first.shape == (4, 24)
    assert envs.action_space.shape == (4,)
    again = UavMecVectorEnv(4)
    again.reset(seed=1)
    ended_before = np.zeros(4, bool)
    for slot in range(25):
        actions = np.array([slot, 2 * slot, 0, 7 * slot]) % 12
        observation, reward, terminated, truncated, info = envs.step(actions)
        chex.assert_trees_all_equal((observation, reward), again.step(actions)[:2])
        assert observation.dtype == np.float32
        assert terminated.dtype == truncated.dtype == bool
        ended = terminated | truncated
        assert_array_equal(info["cause"] != "none", ended)
        if ended.any():
            assert_array_equal(info["_final_obs"], ended)
            assert_allclose(observation[ended], first[ended], atol=1e-6)  # reset in the same step
            for index in np.flatnonzero(ended):
                assert (info["final_obs"][index] != observation[index]).any()
                assert info["final_info"]["failed"][index].any() or info["cause"][index] == "uav"
        ended_before |= ended
    assert ended_before.all()


def test_vector_environment_takes_one_scenario_or_one_for_each():
    scenario = make_scenario()
    assert UavMecVectorEnv(3, scenario).reset(seed=0)[0].shape == (3, 24)
    two = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), scenario)
    assert UavMecVectorEnv(2, two).reset(seed=0)[0].shape == (2, 24)
    with pytest.raises(ValueError, match="scenario holds 2 layouts; it should hold 3"):
        UavMecVectorEnv(3, two)


def test_vector_environment_wants_one_action_for_each_environment():
    envs = UavMecVectorEnv(3)
    envs.reset(seed=0)
    with pytest.raises(AssertionError, match="shape"):
        envs.step(np.zeros(2, int))


def test_the_seed_determines_the_volumes():
    envs = UavMecVectorEnv(2, make_scenario())

    def observations(seed):
        envs.reset(seed=seed)
        return np.stack([envs.step(np.array([3, 3]))[0] for _ in range(3)])

    assert_array_equal(observations(0), observations(0))
    assert (observations(0) != observations(1)).any()
    batteries = observations(0)[:, :, :12]
    assert (batteries[:, 0] != batteries[:, 1]).any()  # the same layout, other volumes


def test_five_values():
    env, params = FiveValueEnv(), FiveValueEnv().default_params
    observation, state = env.reset(jax.random.key(0), params)
    assert observation.shape == (24,)
    step = jax.jit(env.step)
    for _ in range(40):
        observation, state, _, done, info = step(jax.random.key(1), state, 0, params)
        if done:
            break
    assert done
    assert info["discount"] == 0.0
    assert state.slot == 0


def test_five_values_hold_scalars_which_such_libraries_average():
    env = FiveValueEnv()
    _, state = env.reset(jax.random.key(0))
    *_, info = env.step(jax.random.key(1), state, 0)
    assert sorted(info) == ["cause", "discount", "duration", "length", "terminated", "truncated"]
    assert {jnp.shape(value) for value in info.values()} == {()}
    assert env.num_actions == um.UavMecEnv().num_actions == 12


def test_a_missing_gymnax_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnax.environments", None)
    for env in (um.UavMecEnv(), FiveValueEnv()):
        for space in (env.action_space, env.observation_space):
            with pytest.raises(um.UserError, match=r"^gymnax is not installed \(.*\); install it: pip install gymnax$"):
                space()


def test_fleets_are_refused_and_ages_have_no_limit_until_a_horizon():
    params = um.Params()
    layout = um.sample_layout(jax.random.key(0), params, 6, 6)
    two = make_scenario(layout.replace(fleet=um.env.make_fleet(params, 2)), params)
    with pytest.raises(ValueError, match="the layout has 2 UAVs and 0 depots; this interface is for one UAV"):
        UavMecGymEnv(two)
    space = UavMecGymEnv(make_scenario(layout, params.replace(end="horizon"))).observation_space
    assert_array_equal(space.high, np.repeat([1.0, np.inf], 12).astype(np.float32))


@pytest.mark.parametrize("action", [99, -1, 2.5, 12])
def test_an_action_that_is_no_device_is_refused(env, action):
    env.reset(seed=0)
    with pytest.raises(um.ArgumentError, match=r"^action is .*; it should be a whole number from 0 to 11$"):
        env.unwrapped.step(action)
    vector = UavMecVectorEnv(2, env.unwrapped.scenario)
    vector.reset(seed=0)
    with pytest.raises(um.ArgumentError, match=r"^action of environment 2 is .*; it should|^action is array"):
        vector.step(np.array([0, action]))
    with pytest.raises(um.ArgumentError, match=r"^action is .*; it should be a whole number from 0 to 11$"):
        FiveValueEnv().step(jax.random.key(0), um.initial_state(um.Params(), env.unwrapped.scenario.layout), action)


def test_a_scenario_that_cannot_be_is_refused(env):
    scenario = env.unwrapped.scenario
    bad = scenario.replace(params=um.Params(uav_speed_m_s=-5.0))
    for make in (UavMecGymEnv, lambda bad: UavMecVectorEnv(2, bad)):
        with pytest.raises(
            um.ArgumentError, match=r"^params\.uav_speed_m_s of entry 1 is -5|^params\.uav_speed_m_s is -5"
        ):
            make(bad)
    with pytest.raises(um.ArgumentError, match=r"^num_envs is 0; it should be a whole number of at least 1$"):
        UavMecVectorEnv(0)

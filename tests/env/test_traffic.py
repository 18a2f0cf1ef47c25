"""Traffic in a layout and in the reward, worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.small_scenarios import three_devices
from uavmec_jax.env.dynamics import initial_state, transition
from uavmec_jax.env.layout import Traffic
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import make_reward, traffic_reward
from uavmec_jax.env.rollout import returns, rollout, tour_policy
from uavmec_jax.env.scenario import Scenario, advance

pytestmark = pytest.mark.usefixtures("with_and_without_jit")

PARAMS = Params(n_devices=3)
VOLUMES = jnp.full(3, 3e6)  # 300 s of computation each
STATIC = Traffic(weight=jnp.array([[1.0, 0.25, 0.5]]))
MOVING = Traffic(weight=jnp.array([[1.0, 0.0, 0.5], [0.5, 1.0, 0.0]]), window_s=jnp.float32(250.0))

play, play_with_reward = jax.jit(transition), jax.jit(advance)


def test_weights_at_a_time():
    assert_allclose(STATIC.at(1e9), [1, 0.25, 0.5])
    assert_allclose(MOVING.at(0.0), [1, 0, 0.5])
    assert_allclose(MOVING.at(249.9), [1, 0, 0.5])
    assert_allclose(MOVING.at(250.0), [0.5, 1, 0])
    assert_allclose(MOVING.at(1e9), [0.5, 1, 0])  # the last window lasts
    assert_allclose(jax.jit(MOVING.at)(jnp.float32(300.0)), [0.5, 1, 0])


def test_elapsed_is_the_sum_of_the_slots():
    state = initial_state(PARAMS, three_devices())
    durations = []
    for device in (0, 2, 1):
        state, outcome = play(PARAMS, three_devices(), state, jnp.int32(device), VOLUMES)
        durations.append(float(outcome.duration))
    assert_allclose(state.elapsed, sum(durations), rtol=1e-6)
    assert min(durations) >= 300


def test_a_slot_beyond_the_uav_battery_takes_no_time():
    params = Params(n_devices=3, uav_battery_j=100.0)
    state, _ = play(params, three_devices(), initial_state(params, three_devices()), jnp.int32(0), VOLUMES)
    assert state.elapsed == 0


def test_the_bonus_is_for_the_visit():
    layout = three_devices(traffic=STATIC)
    before = initial_state(PARAMS, layout)
    for device, weight in enumerate((1.0, 0.25, 0.5)):
        _, outcome = play(PARAMS, layout, before, jnp.int32(device), VOLUMES)
        bonus = traffic_reward(make_reward(traffic_bonus=8.0), layout, before, jnp.int32(device), outcome)
        assert_allclose(bonus, 8 * weight)


def test_the_bonus_moves_with_the_evacuation():
    layout = three_devices(traffic=MOVING)
    scenario = Scenario(params=PARAMS, layout=layout, reward=make_reward({"U": 0.0}, traffic_bonus=1.0))
    state = initial_state(PARAMS, layout)
    state, first, _ = play_with_reward(scenario, state, jnp.int32(0), VOLUMES)  # takes more than 250 s
    _, second, _ = play_with_reward(scenario, state, jnp.int32(0), VOLUMES)
    assert_allclose([first, second], [1.0, 0.5])


def test_the_penalty_is_for_the_first_failure():
    # Batteries of 1 J: devices 1 and 2 are empty in the first slot unless they are served. Visiting 0 serves 1 as well.
    layout = three_devices(traffic=STATIC, capacity=jnp.array([6e4, 1.0, 1.0]))
    before = initial_state(PARAMS, layout)
    reward = make_reward(traffic_penalty=100.0)
    _, outcome = play(PARAMS, layout, before, jnp.int32(2), VOLUMES)
    assert_allclose(outcome.first_failure.sum(), 1)
    expected = -100 * float(outcome.first_failure @ jnp.array([1.0, 0.25, 0.5]))
    assert_allclose(traffic_reward(reward, layout, before, jnp.int32(2), outcome), expected, rtol=1e-6)
    assert expected < 0
    charged = three_devices(traffic=STATIC)
    before = initial_state(PARAMS, charged)
    _, outcome = play(PARAMS, charged, before, jnp.int32(2), VOLUMES)
    assert traffic_reward(reward, charged, before, jnp.int32(2), outcome) == 0


def test_without_traffic_nothing_changes():
    plain, weighted = make_reward(), make_reward(traffic_bonus=5.0, traffic_penalty=5.0)
    state = initial_state(PARAMS, three_devices())
    rewards = [
        play_with_reward(Scenario(params=PARAMS, layout=layout, reward=reward), state, jnp.int32(1), VOLUMES)[1]
        for layout, reward in (
            (three_devices(), plain),
            (three_devices(), weighted),
            (three_devices(traffic=STATIC), plain),
        )
    ]
    assert_array_equal(rewards, rewards[0])
    assert_allclose(rewards[0], 1 + np.log(1e-6) - np.log(1e-6))


@pytest.mark.slow
def test_returns_are_sums_over_the_same_episodes():
    layout = three_devices(traffic=STATIC)
    policy = tour_policy(jnp.array([0, 2, 1] * 40))
    key = jax.random.key(3)
    scenario = Scenario(params=PARAMS, layout=layout, reward=make_reward("U", traffic_bonus=1.0))
    episode = rollout(policy, PARAMS, layout, key)
    length = int(episode.length)
    bonus = sum([1.0, 0.5, 0.25][slot % 3] for slot in range(length))
    assert_allclose(returns(policy, scenario, key[None])[0], length * (length + 1) / 2 + bonus, rtol=1e-6)
    penalised = Scenario(params=PARAMS, layout=layout, reward=make_reward("U", traffic_penalty=10.0))
    penalty = 10 * float(episode.first_failure @ STATIC.weight[0])
    assert_allclose(returns(policy, penalised, key[None])[0], length * (length + 1) / 2 - penalty, rtol=1e-6)

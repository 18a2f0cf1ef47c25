"""Measures of service on episodes worked by hand; small_fleets.py has the numbers behind them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.env.small_fleets import DEVICE_0, FULL, NORTH, ORIGIN, SLOW, fleet_layout
from uavmec_jax.env.dynamics import Cause, initial_state
from uavmec_jax.env.fleet import make_depots
from uavmec_jax.env.measures import measure, uav_slots
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import rollout, tour_policy, trace, trace_from

KEY = jax.random.key(0)
HORIZON = Params(
    n_devices=3, end="horizon", horizon_s=613.0, data_age_limit_slots=1, task_volume_range_bytes=(3e6, 3e6)
)
DEPOT = 3
TOUR = [[0, DEPOT], [DEPOT, 0], [DEPOT, 0], [0, DEPOT], [0, 0]]
"""UAV 0 serves devices 0 and 1, changes places with UAV 1, which serves them twice, and changes back; then time is over."""
HOVER_S = 1.516768
"""Length of a slot in which only devices 0 and 1 live and are served by a UAV that is there."""


def two_uavs(**values):
    """Device 2 holds 3,000 J and needs 1,950 J a slot: it dies in the second one, two slots old."""
    base = SLOW.replace(capacity=jnp.array([6e4, 6e4, 3e3]), **values)
    return fleet_layout(2, make_depots([ORIGIN]), base=base)


def play(layout, tour, params=HORIZON, slots=6):
    return jax.jit(lambda: trace(tour_policy(jnp.array(tour, jnp.int32)), params, layout, KEY, slots))()


@pytest.fixture(scope="module")
def episode():
    return play(two_uavs(), TOUR)


def test_a_fleet_at_a_swap_depot(episode):
    assert_array_equal(episode.played, [True] * 4 + [False] * 2)
    measures = measure(HORIZON, two_uavs(), episode)
    assert_array_equal([measures.first_failure_slot, measures.first_failure_cause], [2, Cause.BATTERY])
    assert_allclose(measures.in_service, (3 + 2 + 2 + 2) / 12)
    assert_allclose(measures.mean_age, 1 / 9, rtol=1e-6)  # device 2 is dead from the second slot on
    assert measures.age_95 == 1
    assert measures.flights == 1 + 2 + 0 + 2
    there, back = 1500 + 80 * 290, 1500
    energy = there + (back + there) + 80 * HOVER_S + (back + 1500 + 80 * HOVER_S)
    assert_allclose(measures.energy_used_j, energy, rtol=1e-5)
    assert measures.packs_used == 2


def test_what_each_uav_did(episode):
    slots = uav_slots(HORIZON, two_uavs(), episode)
    assert_array_equal(slots.flew[:4], [[True, False], [True, True], [False, False], [True, True]])
    assert_array_equal(slots.depot[:4], [[-1, 0], [0, -1], [0, -1], [-1, 0]])
    assert_array_equal(slots.swapped[:4], [[False, False], [True, False], [False, False], [False, True]])
    assert_allclose(slots.refilled_j[1], [24_700 + 1_500, 0], rtol=1e-5)
    assert not slots.flew[4:].any()
    assert not slots.swapped[4:].any()
    assert not slots.used_j[4:].any()


def test_weights(episode):
    layout = two_uavs(priority=jnp.array([1.0, 1.0, 2.0]))
    assert_allclose(measure(HORIZON, layout, episode).in_service, (4 + 2 + 2 + 2) / 16)
    assert_allclose(measure(HORIZON, layout, episode, jnp.array([0.0, 1.0, 1.0])).in_service, 5 / 8)
    by_slot = jnp.zeros((6, 3)).at[1].set(1.0).at[5].set(9.0)  # the last slot does not belong to the episode
    assert_allclose(measure(HORIZON, layout, episode, by_slot).in_service, 2 / 3)


def test_slots_that_count_as_long_as_they_last(episode):
    """The third and the fourth slot, in which two devices live, last 1.5 s and 11.5 s, the latter after the horizon."""
    measures = measure(HORIZON, two_uavs(), episode, by_time=True)
    assert_allclose(measures.in_service, (300 + (613 - 300) * 2 / 3) / 613, rtol=1e-6)
    assert_allclose(measures.mean_age, 300 / (3 * 300 + 2 * (613 - 300)), rtol=1e-6)
    assert measures.age_95 == 1
    shorter = measure(HORIZON, two_uavs(), episode, jnp.zeros((6, 3)).at[2, 0].set(1.0).at[0, 2].set(1.0), by_time=True)
    assert_allclose(shorter.in_service, 1)


def test_the_service_counts_until_the_horizon(episode):
    """The horizon is 613 s after the start; the last slot ends later."""
    result = rollout(tour_policy(jnp.array(TOUR)), HORIZON, two_uavs(), KEY)
    assert_allclose(episode.state.elapsed[3], 600 + HOVER_S + 10 + HOVER_S, rtol=1e-6)
    assert_allclose(result.service_s, 300 + (613 - 300) * 2 / 3, rtol=1e-6)


def test_padding_counts_nowhere(episode):
    layout = two_uavs(present=jnp.array([True, True, False]))
    measures = measure(HORIZON, layout, play(layout, TOUR))
    assert measures.first_failure_slot == -1
    assert measures.first_failure_cause == Cause.NONE
    assert_allclose([measures.in_service, measures.mean_age, measures.age_95], [1, 0, 0])


def test_expired_data_are_the_first_failure():
    layout = two_uavs(has_power=jnp.array([True, True, True]))
    measures = measure(HORIZON, layout, play(layout, TOUR))
    assert_array_equal([measures.first_failure_slot, measures.first_failure_cause], [2, Cause.DATA_AGE])
    assert_allclose(measures.in_service, (3 + 2 + 2) / 9)  # device 2 works on, so the third slot passes 613 s


def test_charging_is_energy_used_twice():
    """A UAV with 100 kJ charges 667 W * 290 s after its way back, and is away when the first failure ends the episode."""
    params = Params(n_devices=3, data_age_limit_slots=2, task_volume_range_bytes=(3e6, 3e6))
    layout = fleet_layout(1, make_depots([ORIGIN], "charge"))
    begin = initial_state(params, layout).replace(uav_energy=jnp.array([100_000.0]))
    tour = tour_policy(jnp.array([0, 3, 0], jnp.int32))
    slots = jax.jit(lambda: trace_from(tour, params, layout, begin, KEY, 4))()
    there, back, charged = 1500 + 80 * 290, 1500, 667 * 290
    measures = measure(params, layout, slots, start=begin)
    assert_allclose(measures.energy_used_j, there + back + there, rtol=1e-5)
    assert_allclose(slots.state.uav_energy[2], 1e5 + charged - (there + back + there), rtol=1e-6)
    assert_allclose(uav_slots(params, layout, slots, begin).refilled_j[:, 0], [0, charged, 0, 0], rtol=1e-5)
    assert_array_equal([measures.flights, measures.packs_used], [3, 0])
    assert_array_equal([measures.first_failure_slot, measures.first_failure_cause], [3, Cause.DATA_AGE])
    assert_allclose(measures.in_service, 8 / 9)
    assert_array_equal(np.asarray(slots.state.age)[:3], [[0, 0, 1], [1, 1, 2], [0, 0, 3]])
    assert_allclose([measures.mean_age, measures.age_95], [8 / 9, 3], rtol=1e-6)


def test_a_slot_that_no_uav_pays_for_does_not_count():
    params = Params(n_devices=3, task_volume_range_bytes=(3e6, 3e6))
    layout = fleet_layout(1, battery_j=30_000.0)
    measures = measure(params, layout, play(layout, [0, 0], params, slots=3))
    assert measures.first_failure_slot == -1
    assert_allclose([measures.in_service, measures.mean_age], [1, 1 / 3])
    assert_allclose(measures.energy_used_j, 24_700, rtol=1e-6)


def test_a_uav_above_a_device_at_a_depot_hovers():
    """Of two UAVs above device 0, where a depot swaps, one has landed."""
    layout = fleet_layout(2, make_depots([DEVICE_0, NORTH], packs=3), start_m=[DEVICE_0, DEVICE_0])
    slots = play(layout, [[0, 3], [0, 3]], slots=2)
    did = uav_slots(HORIZON, layout, slots)
    assert_array_equal(did.depot, [[-1, 0], [-1, 0]])
    assert not did.swapped.any()
    assert_allclose(did.used_j, [[80 * 300, 0]] * 2, rtol=1e-6)
    low = initial_state(HORIZON, layout).replace(uav_energy=jnp.array([FULL, 10.0]))
    slots = trace_from(tour_policy(jnp.array([[0, 0]])), HORIZON, layout, low, KEY, 1)
    did = uav_slots(HORIZON, layout, slots, low)  # UAV 1 cannot pay for hovering and stays landed
    assert_array_equal(did.depot, [[-1, 0]])
    assert_array_equal(did.swapped, [[False, True]])


def test_a_batch_of_episodes(episode):
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), episode)
    measures = jax.jit(jax.vmap(lambda slots: measure(HORIZON, two_uavs(), slots)))(batch)
    assert_array_equal(measures.flights, [5, 5])

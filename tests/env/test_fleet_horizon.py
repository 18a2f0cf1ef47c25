"""Slots under a horizon, worked by hand: devices fail one by one, and the others go on.

small_fleets.py has the numbers behind them.
"""

import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.env.small_fleets import DEVICE_0, DEVICE_1, FULL, HORIZON, ORIGIN, PARAMS, QUICK, SLOW, fleet_layout, play
from uavmec_jax.env.dynamics import Cause
from uavmec_jax.env.fleet import make_depots
from uavmec_jax.env.params import Params

TWO = fleet_layout(2)


def horizon(**values):
    return Params(n_devices=3, end="horizon", **values)


def test_dead_devices_draw_nothing_and_their_age_stands_still():
    # Device 0 is dead, whatever its battery holds: the UAVs above it serve device 1 alone. Device 2 computes for 300 s.
    changes = {"battery": [5.0, 6e4, 6e4], "age": [4, 5, 6], "failed_at": [2, -1, -1], "slot": 9}
    state, outcome = play(TWO, [0, 0], at=[DEVICE_0, DEVICE_0], params=HORIZON, **changes)
    assert_array_equal(outcome.served, [False, True, False])
    assert_array_equal(outcome.failed, [False] * 3)
    assert_array_equal(state.age, [4, 0, 7])
    assert_allclose(state.battery, [5, 6e4 - 900 - 0.1516768, 6e4 - 1950], rtol=1e-7)
    assert_array_equal(state.failed_at, [2, -1, -1])


def test_the_work_of_dead_devices_does_not_stretch_the_slot():
    layout = fleet_layout(2, base=SLOW.replace(processing_rate=jnp.array([1e6, 1e6, 1e4])))
    _, outcome = play(layout, [0, 0], at=[DEVICE_0, DEVICE_0], params=HORIZON, failed_at=[-1, -1, 0])
    assert_allclose(outcome.duration, 1.516768, rtol=1e-6)


def test_a_device_that_runs_out_is_out_for_good():
    # Device 2 needs 1,950 J. It dies in the slot after which 5 are completed, and aged in it once more.
    state, outcome = play(TWO, [0, 0], at=[DEVICE_0, DEVICE_0], params=HORIZON, battery=[6e4, 6e4, 1900.0], slot=4)
    assert outcome.cause == Cause.NONE
    assert_array_equal(outcome.failed, [False, False, True])
    assert_array_equal(state.failed_at, [-1, -1, 5])
    assert_array_equal(state.age, [0, 0, 1])
    assert state.battery[2] == 0


def test_expired_data_are_out_of_service_until_the_next_visit():
    # Device 2 passes the limit of 10 in this slot, works and ages on in the next, and is fresh once it is visited.
    state, outcome = play(TWO, [0, 0], at=[DEVICE_0, DEVICE_0], params=HORIZON, age=[3, 3, 10])
    assert outcome.cause == Cause.NONE
    assert_array_equal(outcome.failed, [False, False, True])
    assert_array_equal(state.failed_at, [-1] * 3)
    state, outcome = play(TWO, [0, 0], at=[DEVICE_0, DEVICE_0], params=HORIZON, age=[3, 3, 11])
    assert_array_equal(outcome.failed, [False] * 3)
    assert_array_equal(state.age, [0, 0, 12])
    assert_allclose(state.battery[2], 6e4 - 1950, rtol=1e-7)
    assert_allclose(outcome.duration, 300)
    state, outcome = play(TWO, [0, 2], at=[DEVICE_0, DEVICE_0], params=HORIZON, age=[3, 3, 12])
    assert_array_equal(state.age, [0, 0, 0])


def test_slots_go_on_without_uavs():
    state, outcome = play(TWO, [1, 2], params=HORIZON, uav_energy=[1.0, 1.0])
    assert outcome.cause == Cause.NONE
    assert_array_equal(state.grounded, [True, True])
    assert_array_equal(state.age, [1, 1, 1])
    assert_allclose(state.battery, [6e4 - 300 * (2 + 1), 6e4 - 300 * (3 + 1.5), 6e4 - 300 * (4 + 2.5)], rtol=1e-7)
    assert_array_equal([state.slot, state.elapsed, outcome.duration], [1, 300, 300])


@pytest.mark.parametrize(("seconds", "cause"), [(1300.0, Cause.HORIZON), (1299.0, Cause.HORIZON), (1301.0, Cause.NONE)])
def test_the_slot_that_reaches_the_horizon_counts_whole(seconds, cause):
    state, outcome = play(TWO, [0, 0], params=horizon(horizon_s=seconds), elapsed=1000.0, slot=7)
    assert outcome.cause == cause
    assert_array_equal([state.slot, state.elapsed, outcome.duration], [8, 1300, 300])


@pytest.mark.parametrize(
    ("share", "dead", "cause"),
    [
        (1.0, 2, Cause.NONE),
        (1.0, 3, Cause.SHARE),
        (0.5, 1, Cause.NONE),  # ceil(1.5) = 2
        (0.5, 2, Cause.SHARE),
        (1 / 3, 1, Cause.SHARE),  # not 2 because of the last digit
        (2 / 3, 2, Cause.SHARE),
        (0.34, 1, Cause.NONE),
    ],
)
def test_the_share_of_dead_devices_that_ends_an_episode(share, dead, cause):
    failed_at = [3 if d < dead else -1 for d in range(3)]
    assert play(TWO, [0, 0], params=horizon(end_share=share), failed_at=failed_at)[1].cause == cause


def test_the_share_goes_before_the_horizon():
    params = horizon(end_share=0.5, horizon_s=300.0)
    assert play(TWO, [0, 0], params=params, failed_at=[3, -1, -1])[1].cause == Cause.HORIZON
    assert play(TWO, [0, 0], params=params, failed_at=[3, -1, -1], battery=[0.0, 6e4, 1.0])[1].cause == Cause.SHARE


def test_absent_devices_count_in_no_share():
    layout = TWO.replace(present=jnp.array([True, True, False]))
    assert play(layout, [0, 0], params=horizon(end_share=0.5), failed_at=[3, -1, -1])[1].cause == Cause.SHARE


def test_without_living_devices_a_slot_lasts_the_cap():
    # UAV 0 pays 600 s of hovering; a flight of 50 m at 0.05 m/s lasts 1,000 s and with it the slot.
    dead = {"failed_at": [1, 1, 1], "battery": [0.0, 0.0, 0.0], "at": [DEVICE_0, ORIGIN], "params": HORIZON}
    state, outcome = play(fleet_layout(2, base=QUICK), [0, 0], **dead)
    assert_allclose(outcome.duration, 600)
    assert_allclose(state.uav_energy, [FULL - 48_000, FULL - 1500 - 80 * 590], rtol=1e-7)
    assert not outcome.served.any()
    assert outcome.cause == Cause.SHARE
    _, outcome = play(fleet_layout(2, speed_m_s=0.05), [0, 0], **dead)
    assert_allclose(outcome.duration, 1000)


def test_a_uav_without_energy_charges_under_a_horizon_too():
    layout = fleet_layout(2, make_depots([ORIGIN], kind="charge"))
    state, _ = play(layout, [2, 2], at=[ORIGIN, DEVICE_1], params=HORIZON, uav_energy=[1.0, 1.0])
    assert_array_equal(state.grounded, [False, True])
    assert_allclose(state.uav_energy, [200_101, 1], rtol=1e-6)


def test_the_first_failure_ends_the_episode_unless_there_is_a_horizon():
    changes = {"battery": [6e4, 6e4, 1.0], "age": [0, 0, 10]}
    assert play(TWO, [0, 0], params=PARAMS, **changes)[1].cause == Cause.BATTERY
    assert play(TWO, [0, 0], params=PARAMS, age=[0, 0, 10])[1].cause == Cause.DATA_AGE
    assert play(TWO, [0, 0], params=HORIZON, **changes)[1].cause == Cause.NONE

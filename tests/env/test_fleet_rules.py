"""Slots of fleets worked by hand, one rule after the other; small_fleets.py has the numbers behind them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.env.small_fleets import (
    DEVICE_0,
    DEVICE_1,
    DEVICE_2,
    FULL,
    HORIZON,
    NORTH,
    ORIGIN,
    PARAMS,
    QUICK,
    SLOW,
    VOLUMES,
    fleet_layout,
    play,
    step,
)
from tests.small_scenarios import three_devices
from uavmec_jax.env.dynamics import Cause, initial_state
from uavmec_jax.env.fleet import make_depots
from uavmec_jax.env.padding import mask_absent
from uavmec_jax.env.params import Params


def test_first_state_of_a_fleet():
    depots = make_depots([ORIGIN, NORTH], packs=np.array([2, 5]))
    state = initial_state(PARAMS, fleet_layout(3, depots, battery_j=np.array([1e5, 2e5, 3e5])))
    assert_array_equal(state.uav_position, [ORIGIN, NORTH, ORIGIN])
    assert_array_equal(state.uav_energy, [1e5, 2e5, 3e5])
    assert_array_equal(state.grounded, [False] * 3)
    assert_array_equal(state.failed_at, [-1] * 3)
    assert_array_equal(state.packs, [2, 5])


def test_a_device_uploads_to_the_uav_with_which_it_is_through_first():
    # UAV 0 hovers at device 1 already; UAV 1 needs 10 s to device 0 itself. Device 0 is through with UAV 0 after 1.516768 s
    # and pays 0.1 W for them; with UAV 1 it would pay for 0.120395 s, after 10.120395 s. T = 10 s: the flight of UAV 1.
    layout = fleet_layout(2, base=QUICK)
    state, outcome = play(layout, [1, 0], at=[DEVICE_1, ORIGIN], battery=[100.0, 100.0, 1000.0])
    assert_allclose(outcome.duration, 10.0)
    assert_array_equal(outcome.served, [True, True, False])
    assert_allclose(state.battery, [100 - 20 - 0.1516768, 100 - 30 - 0.0120395, 1000 - 40 - 7.5], rtol=1e-6)
    assert_allclose(state.uav_energy, [FULL - 800, FULL - 1500])


@pytest.mark.parametrize(("action", "paid"), [([0, 1], 0.0120395), ([1, 0], 0.1516768)])
def test_ties_go_to_the_lowest_uav(action, paid):
    # A millimetre per 1,000 s: 60 m take 6e7 s, and single precision cannot tell one upload after them from the other.
    layout = fleet_layout(
        2, speed_m_s=1e-6, flying_power_w=0.0, base=three_devices(standby_power=jnp.array([0.0, 3.0, 4.0]))
    )
    at = [(90.0, 40.0), (30.0, 160.0)] if action == [0, 1] else [(30.0, 160.0), (90.0, 40.0)]
    state, _ = play(layout, action, at, battery=[1.0, 6e4, 6e4])
    assert_allclose(1.0 - state.battery[0], paid, rtol=1e-4)


def test_the_slot_lasts_at_least_a_flight_to_a_depot():
    # Device 2 computes for 3 s; UAV 1 flies 10 s to depot 0 and pays for nothing else, UAV 0 hovers for 10 s.
    layout = fleet_layout(2, make_depots([ORIGIN], kind="charge"), base=QUICK)
    state, outcome = play(layout, [0, 3], at=[DEVICE_0, DEVICE_0], uav_energy=[FULL, 5000.0])
    assert_allclose(outcome.duration, 10.0)
    assert_array_equal(state.uav_position, [DEVICE_0, ORIGIN])
    assert_allclose(state.uav_energy, [FULL - 800, 5000 - 1500])  # it lands at the end of the slot: nothing is charged


def test_added_hovering_is_paid_only_by_a_uav_that_hovers():
    # T = 300 s. UAV 0: 150 * 10 + 80 * 300 = 25,500 J; UAV 1 lands, without a pack: 150 * 10 = 1,500 J.
    params = Params(n_devices=3, flight_power_adds_to_hover=True)
    layout = fleet_layout(2, make_depots([ORIGIN], packs=0))
    state, _ = play(layout, [0, 3], at=[ORIGIN, DEVICE_0], params=params)
    assert_allclose(state.uav_energy, [FULL - 25_500, FULL - 1_500], rtol=1e-7)


def test_a_uav_that_cannot_pay_is_charged_at_a_depot_and_grounded_elsewhere():
    # UAV 0 cannot pay 110 s of flight to device 2, 16,500 J. UAV 1 stays at device 0; device 2 computes: T = 300 s.
    layout = fleet_layout(2, make_depots([ORIGIN], kind="charge"))
    state, outcome = play(layout, [2, 0], at=[ORIGIN, DEVICE_0], uav_energy=[1000.0, FULL])
    assert_array_equal(state.grounded, [False, False])
    assert_allclose(state.uav_energy, [1000 + 667 * 300, FULL - 24_000], rtol=1e-7)

    state, outcome = play(layout, [2, 0], at=[(0.0, 1.0), DEVICE_0], uav_energy=[1000.0, FULL])
    assert outcome.cause == Cause.NONE
    assert_array_equal(state.grounded, [True, False])
    assert_array_equal(state.uav_energy[0], 1000)
    assert_array_equal(state.uav_position, [(0.0, 1.0), DEVICE_0])


def test_a_grounded_uav_does_nothing():
    state, outcome = play(fleet_layout(2), [2, 0], at=[DEVICE_2, DEVICE_0], grounded=[True, False])
    assert_array_equal(outcome.served, [True, True, False])
    assert_array_equal(state.uav_energy, [FULL, FULL - 24_000])
    assert_array_equal(state.grounded, [True, False])


def test_a_hopeless_flight_does_not_stretch_the_slot():
    # 110 s of flight would keep UAV 1 hovering for 8,800 J; without them device 2 computes for 3 s and UAV 1 pays 240 J.
    layout = fleet_layout(2, base=QUICK)
    state, outcome = play(layout, [2, 0], at=[ORIGIN, DEVICE_0], uav_energy=[16_499.0, 500.0])
    assert_allclose(outcome.duration, 3.0)
    assert_array_equal(state.grounded, [True, False])
    assert_allclose(state.uav_energy, [16_499, 260], rtol=1e-6)


def test_those_that_cannot_pay_the_slot_are_taken_out_together():
    # With 16,501 J UAV 0 can fly, but not hover for the upload's 0.12 s; UAV 1 is found short in the same round.
    layout = fleet_layout(2, base=QUICK)
    state, outcome = play(layout, [2, 0], at=[ORIGIN, DEVICE_0], uav_energy=[16_501.0, 500.0])
    assert outcome.cause == Cause.UAV
    assert state.slot == 0


@pytest.mark.parametrize("energy", [23_999.0, 24_000.0])
def test_whoever_starts_pays_for_the_slot_without_the_others(energy):
    # With device 2 served, a slot of 3 s costs 240 J; UAV 0 cannot pay, so device 2 computes, and it costs 24,000 J.
    layout = fleet_layout(2, base=three_devices(processing_rate=jnp.array([1e6, 1e6, 1e4])))
    fleet = layout.replace(fleet=layout.fleet.replace(signal_range_m=jnp.array([65.0, 30.0])))
    state, outcome = play(fleet, [2, 0], at=[DEVICE_2, DEVICE_0], uav_energy=[100.0, energy])
    assert outcome.cause == (Cause.NONE if energy == 24_000 else Cause.UAV)
    assert_array_equal(state.uav_energy, [100, 0] if energy == 24_000 else [100, energy])
    assert_array_equal(state.grounded, [energy == 24_000, False])  # nothing changes with a slot that is not played


def test_each_uav_has_its_own_range_speed_and_powers():
    # UAV 0 reaches device 1 from device 0, 60.83 m away, UAV 1 would not. Flights: 50 m at 10 m/s = 5 s, 110 m at 2 m/s.
    layout = fleet_layout(
        2,
        speed_m_s=np.array([10.0, 2.0]),
        flying_power_w=np.array([100.0, 200.0]),
        hovering_power_w=np.array([50.0, 70.0]),
        signal_range_m=np.array([61.0, 60.5]),
    )
    state, outcome = play(layout, [0, 2], at=[ORIGIN, (330.0, 330.0)])
    assert_array_equal(outcome.served, [True, True, True])
    assert_allclose(outcome.duration, 55.120395, rtol=1e-6)
    assert_allclose(state.uav_energy, [FULL - 500 - 50 * 50.120395, FULL - 11_000 - 70 * 0.120395], rtol=1e-7)
    _, outcome = play(layout, [2, 0], at=[DEVICE_2, DEVICE_0])
    assert_array_equal(outcome.served, [True, False, True])


def test_pads_serve_the_lowest_numbers_first_and_packs_run_out():
    # One pad, one pack. UAV 0 is full and takes neither; UAV 1 only arrives, but its number is below that of UAV 2.
    depots = make_depots([ORIGIN], pads=1, packs=1)
    state, _ = play(fleet_layout(3, depots), [3, 3, 3], at=[ORIGIN, DEVICE_0, ORIGIN], uav_energy=[FULL, 5000.0, 7.0])
    assert_array_equal(state.uav_energy, [FULL, FULL, 7])
    assert_array_equal(state.packs, [0])
    state, _ = play(fleet_layout(3, depots), [3, 3, 3], uav_energy=[FULL, FULL, 7.0], packs=[0])
    assert_array_equal(state.uav_energy, [FULL, FULL, 7])
    assert_array_equal(state.packs, [0])


def test_pads_of_a_charging_depot():
    # Two pads for three UAVs: T = 300 s, 200,100 J each; the one that flew 10 s for 1,500 J gets 667 * 290 = 193,430 J.
    depots = make_depots([ORIGIN], kind="charge", pads=2)
    state, _ = play(fleet_layout(3, depots), [3, 3, 3], at=[ORIGIN, DEVICE_0, ORIGIN], uav_energy=[0.0, 1e5, 7.0])
    assert_allclose(state.uav_energy, [200_100, 291_930, 7], rtol=1e-6)


def test_charging_ends_at_the_capacity():
    depots = make_depots([ORIGIN], kind="charge")
    state, _ = play(fleet_layout(2, depots, battery_j=np.array([1e5, 2e5])), [3, 3], uav_energy=[99_000.0, 1000.0])
    assert_array_equal(state.uav_energy, [1e5, 2e5])


def test_depots_in_one_place_are_the_first_of_them():
    depots = make_depots([NORTH, ORIGIN, ORIGIN], packs=np.array([1, 3, 9]))
    state, _ = play(fleet_layout(2, depots), [5, 4], at=[ORIGIN, ORIGIN], uav_energy=[1.0, 1.0])
    assert_array_equal(state.uav_energy, [FULL, FULL])
    assert_array_equal(state.packs, [1, 1, 9])


HELP = {
    "swap": ({}, Cause.NONE, FULL),
    "swap without packs": ({"packs": 0}, Cause.UAV, 9.0),
    "swap in padding": ({"pads": 0.0}, Cause.UAV, 9.0),
    "charge": ({"kind": "charge", "power_w": 10.0}, Cause.NONE, 3009.0),
    "charge without packs": ({"kind": "charge", "power_w": 10.0, "packs": 0}, Cause.NONE, 3009.0),
    "charge without power": ({"kind": "charge", "power_w": 0.0}, Cause.UAV, 9.0),
    "charge in padding": ({"kind": "charge", "pads": 0.0}, Cause.UAV, 9.0),
}


@pytest.mark.parametrize(("depot", "cause", "energy"), HELP.values(), ids=HELP)
def test_the_uavs_end_the_episode_only_where_no_depot_helps(depot, cause, energy):
    # UAV 0 is out at depot 0 and UAV 1 in the field; without them the slot lasts 300 s.
    made = make_depots([ORIGIN], **{name: value for name, value in depot.items() if name != "pads"})
    layout = fleet_layout(2, made.replace(pads=jnp.array([depot.get("pads", 1.0)])))
    state, outcome = play(layout, [2, 2], at=[ORIGIN, DEVICE_0], uav_energy=[9.0, 9.0])
    assert outcome.cause == cause
    assert_array_equal(state.uav_energy, [energy, 9])
    played = cause == Cause.NONE
    assert_array_equal(state.grounded, [False, played])
    assert_array_equal([state.slot, outcome.duration], [1, 300] if played else [0, 0])


def test_staying_at_a_depot_without_packs_is_a_slot():
    state, outcome = play(fleet_layout(1, make_depots([ORIGIN], packs=0)), 3, uav_energy=[0.0])
    assert (outcome.cause, state.slot, state.uav_energy[0]) == (Cause.NONE, 1, 0)


def test_a_slot_that_no_uav_can_start_counts_if_the_parameters_say_so():
    params = Params(n_devices=3, count_unfinished_slot=True)
    state, outcome = play(fleet_layout(2), [0, 1], params=params, uav_energy=[1.0, 1.0])
    assert (outcome.cause, state.slot, state.elapsed) == (Cause.UAV, 1, 0)
    assert_array_equal(state.grounded, [False, False])


@pytest.mark.parametrize("depots", [None, make_depots([ORIGIN, NORTH])], ids=["no depots", "two depots"])
def test_one_uav_takes_a_place_or_a_list_of_one(depots):
    for place in range(3 if depots is None else 5):
        alone = play(fleet_layout(1, depots), place)
        listed = play(fleet_layout(1, depots), [place])
        jax.tree.map(assert_array_equal, alone, listed)


def test_the_uav_of_the_parameters_is_a_fleet_of_one():
    jax.tree.map(assert_array_equal, play(SLOW, 1), play(fleet_layout(1), 1))


def test_places_out_of_range_are_the_nearest():
    layout = fleet_layout(2, make_depots([NORTH]))
    at, full = [DEVICE_1, DEVICE_2], jnp.full(2, FULL)
    jax.tree.map(
        assert_array_equal, play(layout, [-1, 99], at, uav_energy=full), play(layout, [0, 3], at, uav_energy=full)
    )
    jax.tree.map(assert_array_equal, play(SLOW, -1), play(SLOW, 0))
    jax.tree.map(assert_array_equal, play(SLOW, 99), play(SLOW, 2))


def test_padded_uavs_are_grounded_from_the_start():
    # The padding would be at device 2, and at a depot that could help it.
    depots = make_depots([ORIGIN])
    layout = fleet_layout(2, depots, start_m=np.array([DEVICE_0, ORIGIN]), present=np.array([True, False]))
    assert_array_equal(initial_state(PARAMS, layout).grounded, [False, True])
    state, outcome = play(layout, [0, 2])
    assert_array_equal(outcome.served, [True, True, False])
    assert_array_equal(state.uav_position, [DEVICE_0, ORIGIN])
    assert play(layout, [0, 2], uav_energy=[9.0, 9.0])[1].cause == Cause.UAV


def test_what_a_state_leaves_out_has_not_happened():
    layout = fleet_layout(2, make_depots([ORIGIN], packs=1))
    whole = initial_state(HORIZON, layout)
    bare = whole.replace(grounded=None, failed_at=None, packs=None)
    (_, outcome), (_, expected) = (step(HORIZON, layout, state, jnp.array([0, 2]), VOLUMES) for state in (bare, whole))
    jax.tree.map(assert_array_equal, outcome, expected)


@pytest.mark.parametrize("params", [PARAMS, HORIZON], ids=["first_failure", "horizon"])
def test_absent_devices_do_not_stretch_the_slot(params):
    # Devices 0 and 1 are served within 1.516768 s. A connected device would send its results for 8 s; this one is padding.
    layout = mask_absent(fleet_layout(2), jnp.array([True, True, False]))
    _, outcome = play(layout, [0, 0], at=[DEVICE_0, DEVICE_0], params=params.replace(uplink_rate_bit_s=1000.0))
    assert_allclose(outcome.duration, 1.516768, rtol=1e-6)


def test_a_padded_depot_has_no_pads():
    depots = make_depots([ORIGIN]).replace(pads=jnp.zeros(1))
    state, _ = play(fleet_layout(1, depots), 3, uav_energy=[100.0])
    assert_array_equal(state.uav_energy, np.float32([100]))

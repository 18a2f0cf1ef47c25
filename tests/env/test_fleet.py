"""Fleets and depots are made of one value for all or one for each, and bad values are named."""

import re

import jax.numpy as jnp
import pytest
from numpy.testing import assert_array_equal

from tests.env.small_fleets import ORIGIN, PARAMS, fleet_layout
from uavmec_jax.env.fleet import make_depots, make_fleet
from uavmec_jax.env.layout import check_one_uav
from uavmec_jax.env.scenario import make_scenario

TWO_DEPOTS = [ORIGIN, (9.0, 9.0)]


def test_one_value_for_all_or_one_for_each():
    fleet = make_fleet(PARAMS, 2, battery_j=[1e6, 2e6], start_m=[3.0, 4.0])
    assert_array_equal(fleet.battery_j, [1e6, 2e6])
    assert_array_equal(fleet.start_m, [[3, 4], [3, 4]])
    depots = make_depots(TWO_DEPOTS, kind=["swap", "charge"], pads=[1, 2])
    assert_array_equal(depots.kind, [0, 1])
    assert_array_equal(depots.packs, [jnp.inf, jnp.inf])


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (lambda: make_depots(TWO_DEPOTS, kind=["swap"]), "kind has 1 values; give one for all or 2, one per depot"),
        (lambda: make_depots(TWO_DEPOTS, kind="swop"), "kind of depot 1 is 'swop'; give 'swap' or 'charge'"),
        (
            lambda: make_depots(TWO_DEPOTS, pads=[1, 1, 1]),
            "pads has shape (3,); it should be (2,), or () for all alike",
        ),
        (lambda: make_depots(TWO_DEPOTS, pads=0), "pads of depot 1 is 0; it should be a number of at least 1"),
        (lambda: make_depots([(0.0, float("nan"))]), "position of depot 1 is nan; it should be a finite number"),
        (lambda: make_fleet(PARAMS, 0), "uavs is 0; it should be a whole number from 1 to 100"),
        (
            lambda: make_fleet(PARAMS, 2, battery_j=[1e6, 0]),
            "battery_j of UAV 2 is 0; it should be a finite number greater than 0",
        ),
        (
            lambda: make_fleet(PARAMS, 2, flying_power_w=-1),
            "flying_power_w of UAV 1 is -1; it should be a finite number from 0",
        ),
        (lambda: make_fleet(PARAMS, 2, speed_m_s=[5.0]), "speed_m_s has shape (1,); it should be (2,), or () for all"),
        (
            lambda: make_fleet(PARAMS, 1, start_m=[float("nan"), 0]),
            "start_m of UAV 1 is nan; it should be a finite number",
        ),
        (lambda: make_fleet(PARAMS, 1, speed=5.0), "speed is not a field of a fleet; fields are speed_m_s, flying_po"),
    ],
)
def test_bad_values_are_named(make, line):
    with pytest.raises((ValueError, TypeError), match=re.escape(line)):
        make()


def test_actions_are_places():
    assert make_scenario(fleet_layout(2, make_depots(TWO_DEPOTS)), PARAMS).layout.n_places == 5


@pytest.mark.parametrize(
    ("uavs", "depots", "has"),
    [(2, None, "2 UAVs and 0 depots"), (1, make_depots([ORIGIN]), "1 UAV and 1 depot")],
)
def test_what_takes_one_uav_says_so(uavs, depots, has):
    with pytest.raises(ValueError, match=f"the layout has {has}; a bicycle is for one UAV without depots"):
        check_one_uav(fleet_layout(uavs, depots), "a bicycle")

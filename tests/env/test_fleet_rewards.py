"""Reward terms of fleets, worked by hand, on the layout of small_fleets.py."""

import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

from tests.env.small_fleets import DEVICE_0, HORIZON, NORTH, PARAMS, SLOW, VOLUMES, fleet_layout
from uavmec_jax.env.dynamics import initial_state, living_devices, transition
from uavmec_jax.env.fleet import make_depots
from uavmec_jax.env.layout import Traffic
from uavmec_jax.env.rewards import make_reward, reward_of, traffic_reward

TWO = fleet_layout(2, make_depots([NORTH]))


def state(params=HORIZON, layout=TWO, **changes):
    start = initial_state(params, layout)
    return start.replace(**{name: jnp.array(value, getattr(start, name).dtype) for name, value in changes.items()})


def value(term, before, action, after=None, layout=TWO, params=HORIZON):
    after = before if after is None else after
    return reward_of(make_reward({term: 1.0}), layout, before, jnp.array(action, jnp.int32), after, params)


@pytest.mark.parametrize(
    ("action", "changes", "expected"),
    [
        ([0, 1], {}, 5),
        ([1, 0], {}, 5),
        ([0, 0], {}, 3),
        ([0, 3], {}, 3),  # a depot has no data
        ([3, 3], {}, 0),
        ([0, 1], {"grounded": [False, True]}, 3),
        ([0, 1], {"grounded": [True, True]}, 0),
        ([0, 1], {"failed_at": [-1, 4, -1]}, 3),
        ([0, 2], {"uav_energy": [1.0, 1.0]}, 9),  # whether or not they can pay for it
        ([0, 99], {}, 3),  # the last place is the depot
        ([0, -1], {}, 3),
    ],
)
def test_a_is_the_largest_age_among_the_living_targets(action, changes, expected):
    assert value("A", state(age=[3, 5, 9], **changes), action) == expected


def test_places_out_of_range_are_the_nearest_for_the_reward_too():
    for params in (PARAMS, HORIZON):
        for layout in (SLOW, fleet_layout(1), fleet_layout(2)):
            before = state(params, layout, age=[3, 5, 9])
            uavs = layout.n_uavs
            assert value("A", before, [99] * uavs, layout=layout, params=params) == 9
            assert value("A", before, [-1] * uavs, layout=layout, params=params) == 3


def test_what_a_state_leaves_out_has_not_happened():
    bare = state(age=[3, 5, 9]).replace(grounded=None, failed_at=None, packs=None)
    assert [float(value(term, bare, [0, 1])) for term in "AOMS"] == [5, 9, 1, 1]


@pytest.mark.parametrize(("failed_at", "expected"), [([-1, -1, -1], 9), ([-1, -1, 2], 5), ([1, 1, 2], 0)])
def test_o_is_the_oldest_age_of_the_living(failed_at, expected):
    assert value("O", state(age=[3, 5, 9], failed_at=failed_at), [0, 1]) == expected


def test_m_is_zero_once_when_a_device_dies():
    before = state(battery=[3e4, 4.5e4, 600.0])
    dies = state(battery=[1.5e4, 4e4, 0.0], failed_at=[-1, -1, 1])
    after = state(battery=[1.2e4, 4e4, 0.0], failed_at=[-1, -1, 1])
    assert value("M", before, [0, 1], dies) == 0
    assert_allclose(value("M", dies, [0, 1], after), 0.2)
    assert value("M", state(failed_at=[1, 1, 1]), [0, 1]) == 0


def test_u_counts_slots():
    assert value("U", state(slot=4), [0, 1], state(slot=5)) == 5


def test_s_is_the_share_in_service_by_priority():
    layout = TWO.replace(priority=jnp.array([5.0, 2.0, 3.0]))
    for changes, expected in [
        ({}, 1.0),
        ({"age": [10, 11, 0]}, 0.8),  # device 1 has expired
        ({"failed_at": [-1, -1, 3]}, 0.7),
        ({"age": [11, 0, 11], "failed_at": [-1, -1, 3]}, 0.2),
    ]:
        assert_allclose(value("S", state(), [0, 1], state(**changes), layout), expected, rtol=1e-6)
    assert_allclose(value("S", state(), [0, 1], state(age=[11, 0, 0])), 2 / 3, rtol=1e-6)
    absent = layout.replace(present=jnp.array([True, True, False]))
    assert_allclose(value("S", state(), [0, 1], state(age=[11, 0, 0]), absent), 2 / 7, rtol=1e-6)


def test_s_is_added_to_the_other_terms():
    reward = make_reward({"U": 2.0, "S": 0.5})
    after = state(slot=5, failed_at=[1, -1, -1])
    assert_allclose(reward_of(reward, TWO, state(), jnp.array([0, 1]), after, HORIZON), 2 * 5 + 0.5 * 2 / 3, rtol=1e-6)


def test_a_whole_slot():
    # UAV 0 stays at device 0, where device 1 is in range, UAV 1 lands at the depot; device 2 draws 1,950 J and runs out.
    before = state(
        age=[3, 5, 9], uav_position=[DEVICE_0, NORTH], battery=[6e4, 6e4, 1000.0], slot=6, grounded=[False, False]
    )
    action = jnp.array([0, 3])
    after, outcome = transition(HORIZON, TWO, before, action, VOLUMES)
    found = {term: value(term, before, action, after) for term in "AOMUS"}
    assert {term: float(one) for term, one in found.items()} == pytest.approx(
        {"A": 3, "O": 9, "M": 0, "U": 7, "S": 2 / 3}
    )
    assert outcome.failed[2]


def test_the_traffic_bonus_takes_the_largest_weight_among_the_same_targets():
    layout = TWO.replace(traffic=Traffic(jnp.array([[0.2, 0.9, 0.6]])))
    reward = make_reward({}, traffic_bonus=10.0)
    for action, changes, expected in [
        ([0, 1], {}, 9.0),
        ([0, 2], {}, 6.0),
        ([0, 1], {"grounded": [False, True]}, 2.0),
        ([0, 1], {"failed_at": [-1, 2, -1]}, 2.0),
        ([3, 3], {}, 0.0),
    ]:
        before = state(layout=layout, **changes)
        _, outcome = transition(HORIZON, layout, before, jnp.array(action), VOLUMES)
        living = living_devices(HORIZON, layout, before)
        found = traffic_reward(reward, layout, before, jnp.array(action), outcome, living)
        assert_allclose(found, expected, rtol=1e-6)


def test_the_terms_of_one_uav_are_those_of_the_paper():
    layout = fleet_layout(1)
    before, after = state(PARAMS, layout, age=[3, 5, 9]), state(PARAMS, layout, slot=1, battery=[3e4, 6e4, 6e4])
    found = [float(value(term, before, 1, after, layout, PARAMS)) for term in "AOMU"]
    assert found == [5, 9, 0.5, 1]

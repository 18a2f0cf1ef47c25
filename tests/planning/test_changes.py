"""What-if changes: the layouts that are tried, and what their episodes say."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.small_scenarios import three_devices
from uavmec_jax.env.dynamics import complete_state, initial_state
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode
from uavmec_jax.planning.changes import WhatIf, layouts_to_try, rank_changes, states_to_try

FIRST = Params(n_devices=3)
HORIZON = Params(n_devices=3, end="horizon", horizon_s=1000.0)
LAYOUT = three_devices(has_power=(False, True, True), has_comms=(True, True, False))


def episodes(lengths, service_s=None):
    """Episodes of each layout on two draws."""
    lengths = np.broadcast_to(np.array(lengths)[:, None], (len(lengths), 2)).astype(np.int32)
    return Episode(
        length=lengths,
        cause=np.ones_like(lengths),
        failed=np.zeros((*lengths.shape, 3), bool),
        first_failure=np.zeros((*lengths.shape, 3), np.float32),
        service_s=None if service_s is None else np.repeat(np.float32(service_s)[:, None], 2, axis=1),
    )


def test_layouts_until_the_first_failure():
    layouts = layouts_to_try(FIRST, LAYOUT)
    assert layouts.capacity.shape == (10, 3)
    assert layouts.present is None
    assert layouts.priority is None
    assert_array_equal(layouts.has_power[1], [True, True, True])
    assert_array_equal(layouts.has_comms[6], [True, True, True])
    assert_array_equal(layouts.position[9, 2], LAYOUT.position[0])  # the removed device has moved to a neighbour
    assert layouts.processing_rate[9, 2] == jnp.inf


def test_layouts_until_a_horizon_leave_removed_devices_out():
    layouts = layouts_to_try(HORIZON, LAYOUT)
    assert layouts.capacity.shape == (13, 3)
    assert_array_equal(layouts.present[7:10], ~np.eye(3, dtype=bool))
    assert layouts.present[10:].all()
    assert_array_equal(layouts.priority[:10], np.ones((10, 3)))
    assert_array_equal(layouts.priority[10:], 1 - np.eye(3))


def test_gains_of_lifetime():
    ranked = rank_changes(FIRST.replace(max_slots=12), LAYOUT, episodes([8, 9, 0, 0, 0, 0, 11, 8, 12, 7]), 1.0)
    assert ranked == (
        WhatIf(1, "remove", 12, 4, at_least=True),
        WhatIf(2, "repair comms", 11, 3),
        WhatIf(0, "repair power", 9, 1),
        WhatIf(0, "remove", 8, 0),
        WhatIf(2, "remove", 7, -1),
    )


def test_gains_of_service():
    """Without device 1, the others are in service for 700 s instead of 600 s, less than the 800 s with all."""
    service = [800, 900, 0, 0, 0, 0, 850, 500, 700, 800, 500, 600, 850]
    ranked = rank_changes(HORIZON, LAYOUT, episodes([5] * 13, service), 1000.0)
    assert [(effect.device, effect.change) for effect in ranked[:2]] == [(0, "repair power"), (1, "remove")]
    assert_allclose([effect.gain for effect in ranked], [0.1, 0.1, 0.05, 0.0, -0.05], atol=1e-6)
    assert_allclose([effect.service for effect in ranked], [0.9, 0.7, 0.85, 0.5, 0.8], atol=1e-6)
    assert not any(effect.at_least for effect in ranked)


@pytest.mark.parametrize("seconds", [500.0, 2000.0])
def test_service_is_a_share_of_the_time_left(seconds):
    ranked = rank_changes(HORIZON, LAYOUT, episodes([5] * 13, [400] * 13), seconds)
    assert_allclose([effect.service for effect in ranked], 400 / seconds)


def test_who_repairs_a_dead_device_replaces_its_battery():
    state = complete_state(LAYOUT, initial_state(HORIZON, LAYOUT))
    state = state.replace(battery=state.battery.at[0].set(0.0), failed_at=jnp.array([4, -1, -1]))
    states = states_to_try(HORIZON, LAYOUT, state)
    assert states.battery.shape == layouts_to_try(HORIZON, LAYOUT).capacity.shape == (13, 3)
    assert_array_equal(states.failed_at[1], [-1, -1, -1])
    assert_array_equal(states.battery[1], LAYOUT.capacity)
    others = np.delete(np.arange(13), 1)
    assert_array_equal(states.failed_at[others], np.tile([4, -1, -1], (12, 1)))
    assert_array_equal(states.battery[others], np.tile(state.battery, (12, 1)))

"""The full observation: what each feature says, and that it knows nothing of the slot to come."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.small_scenarios import mid_life, three_devices
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.layout import Traffic, pad_layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning import deadlines, demand
from uavmec_jax.planning.observation import FEATURES, observe_devices

observed = jax.jit(observe_devices)
PLACE = {feature.name: number for number, feature in enumerate(FEATURES)}


def features(params, layout, state):
    seen = observed(params, layout, state)
    return {name: np.asarray(seen.features[:, number]) for name, number in PLACE.items()}


@pytest.fixture(scope="module")
def small():
    params = Params(n_devices=3)
    layout = three_devices(has_power=(False, False, True), has_comms=(False, True, False))
    state = initial_state(params, layout)
    return params, layout, state.replace(age=jnp.array([4, 0, 7]), battery=jnp.array([30_000.0, 60_000.0, 60_000.0]))


def test_numbers_worked_out_by_hand(small):
    """Volumes of 3 MB are expected: 300 s of work everywhere, so the slot is 300 s long unless the last one is served."""
    params, layout, state = small
    seen = features(params, layout, state)
    assert_array_equal(seen["lacks_power"], [1, 1, 0])
    assert_array_equal(seen["lacks_comms"], [1, 0, 1])
    assert_allclose(seen["age"], [4 / 11, 0, 7 / 11], rtol=1e-6)
    assert_allclose(seen["due"], [7 / 11, 2, 4 / 11], rtol=1e-6)
    drain = np.array([2.0 * 300 + 1.0 * 300, 3.0 * 300 + 1.5 * 300])
    assert_allclose(seen["life_unvisited"][:2], np.minimum(np.array([30_000, 60_000]) / drain / 32, 2), rtol=1e-3)
    assert seen["life_unvisited"][2] == 2.0
    assert_allclose(seen["flight"], np.array([50, np.hypot(30, 100), 550]) / 5.0 / 300, rtol=1e-3)
    assert_array_equal(seen["here"], [0, 0, 0])
    assert_allclose(seen["together"], [2 / 4, 2 / 4, 1 / 4])  # the first two share their hover points
    assert_allclose(seen["oldest_served"], [4 / 11, 4 / 11, 7 / 11], rtol=1e-6)
    assert_allclose(seen["all_lack_power"], 2 / 3, rtol=1e-6)
    assert_allclose(seen["devices"], np.log2(3) / 6, rtol=1e-6)
    assert_array_equal(seen["traffic_price"], [0, 0, 0])


@pytest.mark.slow
def test_what_is_hoped_for_is_what_the_rule_hopes_for():
    for seed in range(2):
        params, layout, state = mid_life(seed, 12)
        charged = demand.visit_shares(layout, demand.coverage(params, layout))
        slots, services = deadlines.feasible_horizon(params, layout, state, demand.mean_slot(params, layout), charged)
        seen = features(params, layout, state)
        assert_allclose(seen["hoped"], slots / 32, rtol=1e-6)
        assert_allclose(seen["services"], services / slots, rtol=1e-6)


@pytest.mark.slow
def test_data_that_cannot_be_fetched_in_time_are_seen():
    params, layout, state = mid_life(3, 12)
    lost = state.replace(age=jnp.where(layout.has_comms, 0, 10))
    fine = state.replace(age=jnp.zeros(12, jnp.int32))
    assert not features(params, layout, lost)["on_time_after"].any()
    assert features(params, layout, fine)["on_time_after"].all()
    assert features(params, layout, lost)["can_wait"].max() == 0
    assert features(params, layout, fine)["can_wait"].min() == 1


@pytest.mark.slow
def test_traffic_shows_at_its_price():
    params, layout, state = mid_life(0, 5)
    weight = jnp.array([[0.0, 0.25, 0.5, 0.75, 1.0], [1.0, 0.0, 0.0, 0.0, 0.0]])
    for price, row, elapsed in ((8.0, 0, 10.0), (4.0, 1, 5000.0)):
        there = layout.replace(traffic=Traffic(weight, jnp.float32(600.0), jnp.float32(price)))
        seen = features(params, there, state.replace(elapsed=jnp.float32(elapsed)))
        assert_allclose(seen["traffic_price"], np.asarray(weight[row]) * price / 8)
    free = features(params, layout.replace(traffic=Traffic(weight, jnp.float32(600.0))), state)
    assert_array_equal(free["traffic_price"], 0)


@pytest.mark.slow
def test_entries_that_are_no_devices_show_nothing():
    params, layout, state = mid_life(1, 4)
    more = state.replace(battery=jnp.append(state.battery, 1.0), age=jnp.append(state.age, 0))
    seen, whole = observed(params, pad_layout(layout, 5), more), observed(params, layout, state)
    assert_array_equal(seen.mask, [True] * 4 + [False])
    assert_array_equal(seen.features[4], 0)
    assert_allclose(seen.features[:4], whole.features, rtol=1e-5, atol=1e-6)
    assert whole.mask.all()


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 12, 64])
def test_all_features_are_finite_and_moderate(n):
    for seed in range(3):
        params, layout, state = mid_life(seed, n)
        for now in (state, initial_state(params, layout)):
            seen = np.asarray(observed(params, layout, now).features)
            assert np.isfinite(seen).all()
            assert np.abs(seen).max() < 20


def test_the_documentation_has_every_feature():
    text = (Path(__file__).parents[2] / "docs" / "generalist.md").read_text(encoding="utf-8")
    for feature in FEATURES:
        assert f"| `{feature.name}` | {feature.unit} | {feature.source} |" in text

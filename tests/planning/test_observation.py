"""The full observation: the value of each feature."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.small_scenarios import mid_life, three_devices
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.layout import Traffic
from uavmec_jax.env.padding import pad_layout
from uavmec_jax.env.params import Params
from uavmec_jax.errors import ArgumentError
from uavmec_jax.planning import deadlines, demand
from uavmec_jax.planning.observation import FEATURES, observe_devices

observe = jax.jit(observe_devices)
COLUMN = {feature.name: column for column, feature in enumerate(FEATURES)}


def features(params, layout, state):
    observation = observe(params, layout, state)
    return {name: np.asarray(observation.features[:, column]) for name, column in COLUMN.items()}


@pytest.fixture(scope="module")
def small():
    params = Params(n_devices=3)
    layout = three_devices(has_power=(False, False, True), has_comms=(False, True, False))
    state = initial_state(params, layout)
    return params, layout, state.replace(age=jnp.array([4, 0, 7]), battery=jnp.array([30_000.0, 60_000.0, 60_000.0]))


def test_values_computed_by_hand(small):
    """Volumes of 3 MB are expected: 300 s of work everywhere, so the slot is 300 s long unless the last one is served."""
    params, layout, state = small
    values = features(params, layout, state)
    assert_array_equal(values["lacks_power"], [1, 1, 0])
    assert_array_equal(values["lacks_comms"], [1, 0, 1])
    assert_allclose(values["age"], [4 / 11, 0, 7 / 11], rtol=1e-6)
    assert_allclose(values["due"], [7 / 11, 2, 4 / 11], rtol=1e-6)
    drain = np.array([2.0 * 300 + 1.0 * 300, 3.0 * 300 + 1.5 * 300])
    assert_allclose(values["life_unvisited"][:2], np.minimum(np.array([30_000, 60_000]) / drain / 32, 2), rtol=1e-3)
    assert values["life_unvisited"][2] == 2.0
    assert_allclose(values["flight"], np.array([50, np.hypot(30, 100), 550]) / 5.0 / 300, rtol=1e-3)
    assert_array_equal(values["here"], [0, 0, 0])
    assert_allclose(values["together"], [2 / 4, 2 / 4, 1 / 4])  # the first two share their hover points
    assert_allclose(values["oldest_served"], [4 / 11, 4 / 11, 7 / 11], rtol=1e-6)
    assert_allclose(values["all_lack_power"], 2 / 3, rtol=1e-6)
    assert_allclose(values["devices"], np.log2(3) / 6, rtol=1e-6)
    assert_array_equal(values["traffic_price"], [0, 0, 0])


@pytest.mark.slow
def test_the_horizon_is_that_of_earliest_deadline():
    for seed in range(2):
        params, layout, state = mid_life(seed, 12)
        visit_share = demand.visit_shares(layout, demand.coverage(params, layout))
        slots, services = deadlines.feasible_horizon(
            params, layout, state, demand.mean_slot(params, layout), visit_share
        )
        values = features(params, layout, state)
        assert_allclose(values["hoped"], slots / 32, rtol=1e-6)
        assert_allclose(values["services"], services / slots, rtol=1e-6)


@pytest.mark.slow
def test_data_that_cannot_be_collected_in_time_are_flagged():
    params, layout, state = mid_life(3, 12)
    late = features(params, layout, state.replace(age=jnp.where(layout.has_comms, 0, 10)))
    fresh = features(params, layout, state.replace(age=jnp.zeros(12, jnp.int32)))
    assert not late["on_time_after"].any()
    assert fresh["on_time_after"].all()
    assert late["can_wait"].max() == 0
    assert fresh["can_wait"].min() == 1


@pytest.mark.slow
def test_traffic_is_weighted_with_its_price():
    params, layout, state = mid_life(0, 5)
    weight = jnp.array([[0.0, 0.25, 0.5, 0.75, 1.0], [1.0, 0.0, 0.0, 0.0, 0.0]])
    for price, row, elapsed in ((8.0, 0, 10.0), (4.0, 1, 5000.0)):
        priced = layout.replace(traffic=Traffic(weight, jnp.float32(600.0), jnp.float32(price)))
        values = features(params, priced, state.replace(elapsed=jnp.float32(elapsed)))
        assert_allclose(values["traffic_price"], np.asarray(weight[row]) * price / 8)
    free = features(params, layout.replace(traffic=Traffic(weight, jnp.float32(600.0))), state)
    assert_array_equal(free["traffic_price"], 0)


@pytest.mark.slow
def test_features_of_padding_are_zero():
    params, layout, state = mid_life(1, 4)
    padded_state = state.replace(battery=jnp.append(state.battery, 1.0), age=jnp.append(state.age, 0))
    padded, unpadded = observe(params, pad_layout(layout, 5), padded_state), observe(params, layout, state)
    assert_array_equal(padded.mask, [True] * 4 + [False])
    assert_array_equal(padded.features[4], 0)
    assert_allclose(padded.features[:4], unpadded.features, rtol=1e-5, atol=1e-6)
    assert unpadded.mask.all()


def test_a_state_of_another_number_of_devices_is_refused(small):
    params, layout, state = small
    of_four = {"battery": jnp.ones(4), "age": jnp.zeros(4, jnp.int32), "failed_at": jnp.full(4, -1)}
    with pytest.raises(ArgumentError, match=r"state\.battery has shape \(4,\); it should be \(3,\), one per device"):
        observe_devices(params, layout, state.replace(**of_four))


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 12, 64])
def test_all_features_are_finite_and_of_moderate_size(n):
    for seed in range(3):
        params, layout, state = mid_life(seed, n)
        for now in (state, initial_state(params, layout)):
            values = np.asarray(observe(params, layout, now).features)
            assert np.isfinite(values).all()
            assert np.abs(values).max() < 20


def test_the_documentation_lists_every_feature():
    text = (Path(__file__).parents[2] / "docs" / "generalist.md").read_text(encoding="utf-8")
    for feature in FEATURES:
        assert f"| `{feature.name}` | {feature.unit} | {feature.source} |" in text

"""Forecasts: the statistics of simulated episodes."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.small_scenarios import mid_life
from uavmec_jax.env.dynamics import Cause
from uavmec_jax.env.rollout import Episode, rollout_from, rollouts
from uavmec_jax.planning.forecast import SAMPLES, Forecast, make_forecast
from uavmec_jax.planning.heuristics import HEURISTICS

POLICY = HEURISTICS["oldest-first"]


def episodes(length, cause, first_failure):
    share = jnp.asarray(first_failure, jnp.float32)
    return Episode(
        length=jnp.asarray(length, jnp.int32),
        cause=jnp.asarray(cause, jnp.int32),
        failed=share > 0,
        first_failure=share,
    )


@pytest.fixture(scope="module")
def forecast():
    """Four episodes of three devices: 0 fails twice and once together with 1, once the UAV's battery ends the episode."""
    return Forecast.of(
        episodes(
            length=[10, 14, 12, 20],
            cause=[Cause.BATTERY, Cause.BATTERY, Cause.DATA_AGE, Cause.UAV],
            first_failure=[[1, 0, 0], [1, 0, 0], [0.5, 0.5, 0], [0, 0, 0]],
        )
    )


def test_probabilities_are_shares_of_the_episodes(forecast):
    assert_array_equal(forecast.lifetimes, [10, 14, 12, 20])
    assert_allclose(forecast.first_failure, [2.5 / 4, 0.5 / 4, 0])
    assert forecast.no_failure == pytest.approx(1 / 4)


def test_failure_slots_are_means_over_the_episodes_in_which_a_device_fails_first(forecast):
    assert_allclose(forecast.failure_slot[:2], [(10 + 14 + 0.5 * 12) / 2.5, 12])
    assert np.isnan(forecast.failure_slot[2])


def test_causes_that_do_not_occur_are_left_out(forecast):
    assert forecast.causes == {Cause.BATTERY: 0.5, Cause.DATA_AGE: 0.25, Cause.UAV: 0.25}


def test_the_interval_holds_95_percent_of_the_lifetimes():
    of_1000 = Forecast.of(episodes(np.arange(1, 1001), np.full(1000, Cause.UAV), np.zeros((1000, 2))))
    low, high = of_1000.interval
    assert np.mean((of_1000.lifetimes >= low) & (of_1000.lifetimes <= high)) == pytest.approx(0.95)


def test_no_failure_is_not_negative():
    certain = Forecast.of(episodes([5] * 3, [Cause.DATA_AGE] * 3, [[1 / 3] * 3] * 3))
    assert 0 <= certain.no_failure <= 1e-6
    assert certain.causes == {Cause.DATA_AGE: 1.0}


def test_make_forecast_summarises_rollouts():
    params, layout, _ = mid_life(2, 6)
    futures = jax.random.split(jax.random.key(7), 32)
    result = make_forecast(POLICY, params, layout, key=jax.random.key(7), samples=32)
    simulated = Forecast.of(jax.jit(lambda: rollouts(POLICY, params, layout, futures))())
    chex.assert_trees_all_close(vars(result), vars(simulated), rtol=1e-6)


def test_make_forecast_starts_from_the_present_state():
    params, layout, state = mid_life(2, 6)
    result = make_forecast(POLICY, params, layout, state, samples=8)
    futures = jax.random.split(jax.random.key(0), 8)
    simulate = jax.jit(jax.vmap(lambda future: rollout_from(POLICY, params, layout, state, future).length))
    assert_array_equal(result.lifetimes, simulate(futures))
    assert result.lifetimes.min() > int(state.slot)


def test_a_forecast_has_256_futures_by_default():
    params, layout, state = mid_life(2, 6)
    first, again = (make_forecast(POLICY, params, layout, state) for _ in range(2))
    assert len(first.lifetimes) == SAMPLES == 256
    assert_array_equal(first.lifetimes, again.lifetimes)

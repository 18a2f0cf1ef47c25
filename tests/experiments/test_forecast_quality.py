"""Forecasts of the first failure and their quality: worked out by hand, and for scenarios whose outcome is certain."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from forecast_quality import evaluate_forecasts, forecast_first_failure, with_no_failure
from numpy.testing import assert_allclose, assert_array_equal

from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning.heuristics import HEURISTICS


def test_quality_worked_out_by_hand():
    forecast = np.array([[0.7, 0.3, 0.0], [0.4, 0.6, 0.0], [0.1, 0.1, 0.8]])
    happened = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    quality = evaluate_forecasts(forecast, happened, bins=2)
    assert_array_equal(quality.correct, [True, False, True])
    assert_allclose(quality.brier, [0.09 + 0.09, 0.36 + 0.36, 0.01 + 0.01 + 0.04])
    low, high = quality.reliability.itertuples()
    assert (low.count, high.count) == (6, 3)
    assert_allclose([low.forecast, low.happened], [(0.3 + 0 + 0.4 + 0 + 0.1 + 0.1) / 6, 1 / 6])
    assert_allclose([high.forecast, high.happened], [(0.7 + 0.6 + 0.8) / 3, 2 / 3])


def test_a_device_that_shares_the_first_failure_is_correct():
    quality = evaluate_forecasts(np.array([[0.2, 0.5, 0.3]]), np.array([[0.5, 0.5, 0.0]]))
    assert quality.correct.all()


def test_the_rest_is_the_probability_of_no_failure():
    assert_allclose(with_no_failure(np.array([[0.25, 0.25], [0.5, 0.5]])), [[0.25, 0.25, 0.5], [0.5, 0.5, 0.0]])


@pytest.mark.full
def test_probabilities_of_two_scenarios():
    params = Params(n_devices=4)
    keys = jax.random.split(jax.random.key(0), 2)
    layouts = jax.vmap(lambda key, n: sample_layout(key, params, n, n))(keys, jnp.array([4, 0]))
    batch = jax.tree.map(lambda leaf: jnp.full(2, leaf), params)
    forecast = forecast_first_failure(HEURISTICS["oldest-first"], batch, layouts, samples=32)
    assert forecast.shape == (2, 5)
    assert_allclose(forecast.sum(axis=1), 1, rtol=1e-6)
    assert_allclose(forecast[0], [0, 0, 0, 0, 1])  # a device with power and communication cannot fail
    assert forecast[1, :4].sum() > 0.99

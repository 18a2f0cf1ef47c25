"""Forecasts of the first failure against what happened: worked out by hand, and on a town that is sure."""

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
    assert_array_equal(quality.named_right, [True, False, True])
    assert_allclose(quality.brier, [0.09 + 0.09, 0.36 + 0.36, 0.01 + 0.01 + 0.04])
    low, high = quality.reliability.itertuples()
    assert (low.count, high.count) == (6, 3)
    assert_allclose([low.forecast, low.happened], [(0.3 + 0 + 0.4 + 0 + 0.1 + 0.1) / 6, 1 / 6])
    assert_allclose([high.forecast, high.happened], [(0.7 + 0.6 + 0.8) / 3, 2 / 3])


def test_who_shares_the_first_failure_is_named_right():
    quality = evaluate_forecasts(np.array([[0.2, 0.5, 0.3]]), np.array([[0.5, 0.5, 0.0]]))
    assert quality.named_right.all()


def test_nobody_has_the_rest():
    assert_allclose(with_no_failure(np.array([[0.25, 0.25], [0.5, 0.5]])), [[0.25, 0.25, 0.5], [0.5, 0.5, 0.0]])


@pytest.mark.slow
def test_probabilities_of_two_towns():
    params = Params(n_devices=4)
    keys = jax.random.split(jax.random.key(0), 2)
    layouts = jax.vmap(lambda key, n: sample_layout(key, params, n, n))(keys, jnp.array([4, 0]))
    every = jax.tree.map(lambda leaf: jnp.full(2, leaf), params)
    found = forecast_first_failure(HEURISTICS["oldest-first"], every, layouts, samples=32)
    assert found.shape == (2, 5)
    assert_allclose(found.sum(axis=1), 1, rtol=1e-6)
    assert_allclose(found[0], [0, 0, 0, 0, 1])  # who lacks nothing cannot fail
    assert found[1, :4].sum() > 0.99

"""Means and their intervals."""

import numpy as np
from numpy.testing import assert_allclose

from uavmec_jax.studies.statistics import mean_interval


def test_interval_covers_the_mean_and_repeats():
    values = np.random.default_rng(0).normal(20, 5, 40)
    mean, low, high = mean_interval(values)
    assert_allclose(mean, values.mean())
    assert low < mean < high
    # The percentile bootstrap of a mean is close to mean +- 1.96 s / sqrt(n).
    half = 1.96 * values.std() / np.sqrt(40)
    assert_allclose([low, high], [mean - half, mean + half], atol=0.25)
    assert mean_interval(values) == (mean, low, high)


def test_interval_of_equal_values_and_of_one():
    assert mean_interval(np.array([33, 33, 33])) == (33, 33, 33)
    mean, low, high = mean_interval(np.array([12.0]))
    assert mean == 12
    assert np.isnan([low, high]).all()


def test_coverage_is_near_95_percent():
    rng = np.random.default_rng(1)
    intervals = [mean_interval(rng.normal(0, 1, 30)) for _ in range(200)]
    assert 0.87 < np.mean([low <= 0 <= high for _, low, high in intervals]) < 0.99

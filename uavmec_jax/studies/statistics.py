"""Means and their confidence intervals."""

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
_RESAMPLES = 9999


def mean_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Mean of ``[S]`` values with a 95 % percentile-bootstrap interval over them: ``(mean, low, high)``.

    The resampling is seeded, so the same values give the same interval. With a single value the interval is NaN.
    """
    values = np.asarray(values, float)
    mean = float(values.mean())
    if values.size < 2:
        return mean, float("nan"), float("nan")
    if np.ptp(values) == 0:
        return mean, mean, mean
    found = stats.bootstrap(
        (values,), np.mean, confidence_level=CONFIDENCE, n_resamples=_RESAMPLES, method="percentile", rng=0
    ).confidence_interval
    return mean, float(found.low), float(found.high)

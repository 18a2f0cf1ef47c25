"""Means with their confidence intervals, and the sign test."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Num
from scipy import stats

CONFIDENCE = 0.95
_RESAMPLES = 9999


def mean_interval(values: Num[np.ndarray, " S"]) -> tuple[float, float, float]:
    """Return the mean of values with its 95 % percentile-bootstrap interval: ``(mean, low, high)``.

    The resampling is seeded, so the same values give the same interval. With a single value the interval is NaN.
    """
    values = np.asarray(values, float)
    mean = float(values.mean())
    if values.size < 2:
        return mean, float("nan"), float("nan")
    if np.ptp(values) == 0:
        return mean, mean, mean
    interval = stats.bootstrap(
        (values,), np.mean, confidence_level=CONFIDENCE, n_resamples=_RESAMPLES, method="percentile", rng=0
    ).confidence_interval
    return mean, float(interval.low), float(interval.high)


@dataclass(frozen=True)
class SignTest:
    """Result of the sign test of paired differences.

    Attributes:
        fewer, more, same: number of differences below, above and equal to 0.
        p_value: two-sided exact p-value under the null hypothesis that ``fewer`` and ``more`` are equally likely.
        g: Cohen's g: the share of ``fewer`` among the differences other than 0, minus one half. 0 is no effect, 0.5 the
            largest; 0 if all differences are 0.
    """

    fewer: int
    more: int
    same: int
    p_value: float
    g: float


def sign_test(differences: Num[np.ndarray, " S"], tolerance: float = 1e-6) -> SignTest:
    """Perform the exact sign test on paired differences (McNemar's exact test where the values are 0 and 1).

    Args:
        differences: paired differences.
        tolerance: largest absolute difference that counts as 0.
    """
    fewer, more = int((differences < -tolerance).sum()), int((differences > tolerance).sum())
    changed = fewer + more
    p_value = float(stats.binomtest(fewer, changed).pvalue) if changed else 1.0
    return SignTest(fewer, more, differences.size - changed, p_value, fewer / changed - 0.5 if changed else 0.0)

"""Means and their confidence intervals."""

from dataclasses import dataclass

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


@dataclass(frozen=True)
class SignTest:
    """Of paired values, how many went down and up, and how likely that is by chance.

    Attributes:
        fewer, more, same: pairs whose difference is below, above and equal to 0.
        p_value: exact, two-sided: of a fair coin for each pair that is not the same.
        g: Cohen's g, the share of ``fewer`` among the pairs that are not the same, less a half: 0 is no effect, 0.5 the
            largest; 0 where all are the same.
    """

    fewer: int
    more: int
    same: int
    p_value: float
    g: float


def sign_test(differences: np.ndarray, tolerance: float = 1e-6) -> SignTest:
    """The exact sign test of paired differences (McNemar's exact test where values are 0 and 1)."""
    fewer, more = int((differences < -tolerance).sum()), int((differences > tolerance).sum())
    changed = fewer + more
    p_value = float(stats.binomtest(fewer, changed).pvalue) if changed else 1.0
    return SignTest(fewer, more, differences.size - changed, p_value, fewer / changed - 0.5 if changed else 0.0)

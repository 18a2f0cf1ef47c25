"""Forecasts of the first failure: a probability for every device, and how good such forecasts are."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Key

from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy
from uavmec_jax.planning.parallel import policy_episodes

_STREAM = 7
"""Seed of the forecasts' own futures."""


def forecast_first_failure(policy: Policy, params: Params, layouts: Layout, samples: int = 256) -> np.ndarray:
    """Probability ``[B, n + 1]`` of every device, and last of none, to be the first to fail, from the first slot on.

    Args:
        policy: who decides in the field.
        params: leaves ``[B]``.
        layouts: leaves ``[B, n]``.
        samples: futures of each scenario.
    """
    count = layouts.capacity.shape[0]
    keys = _futures(count, samples)
    return with_no_failure(np.asarray(policy_episodes(policy, params, layouts, keys).first_failure).mean(axis=1))


@partial(jax.jit, static_argnums=(0, 1))
def _futures(count: int, samples: int) -> Key[Array, "B S"]:
    fold = lambda scenario: jax.random.split(jax.random.fold_in(jax.random.key(_STREAM), scenario), samples)  # noqa: E731
    return jax.vmap(fold)(jnp.arange(count))


def with_no_failure(share: np.ndarray) -> np.ndarray:
    """``[..., n + 1]``: the share of the episodes in which no device fails behind those of the devices."""
    return np.concatenate([share, np.maximum(1.0 - share.sum(axis=-1, keepdims=True), 0.0)], axis=-1)


@dataclass(frozen=True)
class ForecastQuality:
    """How good forecasts were over ``E`` episodes.

    Attributes:
        named_right: ``[E]`` whether the outcome named as the likeliest was (among) the first to fail.
        brier: ``[E]`` sum over the outcomes of the squared difference from what happened, 0 to 2 (Brier 1950).
        reliability: one row per bin of forecast probabilities: ``low``, ``high``, mean ``forecast``, share that
            ``happened``, ``count``.
    """

    named_right: np.ndarray
    brier: np.ndarray
    reliability: pd.DataFrame


def evaluate_forecasts(forecast: np.ndarray, happened: np.ndarray, bins: int = 10) -> ForecastQuality:
    """Hold forecasts against what happened.

    Args:
        forecast: ``[E, n + 1]`` probabilities.
        happened: ``[E, n + 1]`` share of every outcome in the first failure, summing to 1.
        bins: of equal width, for the reliability diagram.
    """
    named = forecast.argmax(axis=1)
    right = happened[np.arange(len(happened)), named] > 0
    p, o = forecast.ravel(), happened.ravel()
    edges = np.linspace(0.0, 1.0, bins + 1)
    place = np.clip(np.digitize(p, edges[1:-1]), 0, bins - 1)
    rows: list[dict[str, Any]] = []
    for number in range(bins):
        inside = place == number
        if inside.any():
            rows.append(
                {
                    "low": edges[number],
                    "high": edges[number + 1],
                    "forecast": p[inside].mean(),
                    "happened": o[inside].mean(),
                    "count": int(inside.sum()),
                }
            )
    return ForecastQuality(right, np.square(forecast - happened).sum(axis=1), pd.DataFrame(rows))

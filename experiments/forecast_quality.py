"""Forecasts of the first failure, a probability for every device, and measures of their quality."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Bool, Float, Key

from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy
from uavmec_jax.planning.parallel import policy_episodes

_STREAM = 7
"""Seed of the futures that forecasts are made of."""


def forecast_first_failure(
    policy: Policy, params: Params, layouts: Layout, samples: int = 256
) -> Float[np.ndarray, "B n_and_none"]:
    """Forecast which device fails first, from the first slot on.

    Args:
        policy: decides in every slot.
        params: leaves ``[B]``.
        layouts: leaves ``[B, n]``.
        samples: futures of each scenario.

    Returns:
        ``[B, n + 1]`` probability of every device, and last of none, to be the first to fail.
    """
    count = layouts.capacity.shape[0]
    keys = _future_keys(count, samples)
    return with_no_failure(np.asarray(policy_episodes(policy, params, layouts, keys).first_failure).mean(axis=1))


@partial(jax.jit, static_argnums=(0, 1))
def _future_keys(count: int, samples: int) -> Key[Array, "B S"]:
    root = jax.random.key(_STREAM)
    return jax.vmap(lambda i: jax.random.split(jax.random.fold_in(root, i), samples))(jnp.arange(count))


def with_no_failure(share: Float[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch n_and_none"]:
    """Append to the devices' shares ``[..., n]`` of the first failures the share of episodes in which no device fails."""
    return np.concatenate([share, np.maximum(1.0 - share.sum(axis=-1, keepdims=True), 0.0)], axis=-1)


@dataclass(frozen=True)
class ForecastQuality:
    """The quality of forecasts over ``E`` episodes.

    Attributes:
        correct: ``[E]`` whether the outcome with the highest probability was (among) the first to fail.
        brier: ``[E]`` Brier score: the squared difference from what happened, summed over the outcomes, 0 to 2 (Brier 1950).
        reliability: one row per bin of forecast probabilities: ``low``, ``high``, mean ``forecast``, share that
            ``happened``, ``count``.
    """

    correct: Bool[np.ndarray, " E"]
    brier: Float[np.ndarray, " E"]
    reliability: pd.DataFrame


def evaluate_forecasts(
    forecast: Float[np.ndarray, "E outcomes"], happened: Float[np.ndarray, "E outcomes"], bins: int = 10
) -> ForecastQuality:
    """Compare forecasts with what happened.

    Args:
        forecast: ``[E, n + 1]`` probabilities.
        happened: ``[E, n + 1]`` share of every outcome in the first failure, summing to 1.
        bins: number of bins of equal width in the reliability diagram.
    """
    likeliest = forecast.argmax(axis=1)
    correct = happened[np.arange(len(happened)), likeliest] > 0
    probability, outcome = forecast.ravel(), happened.ravel()
    edges = np.linspace(0.0, 1.0, bins + 1)
    bin_of = np.clip(np.digitize(probability, edges[1:-1]), 0, bins - 1)
    rows: list[dict[str, Any]] = []
    for number in range(bins):
        inside = bin_of == number
        if inside.any():
            rows.append(
                {
                    "low": edges[number],
                    "high": edges[number + 1],
                    "forecast": probability[inside].mean(),
                    "happened": outcome[inside].mean(),
                    "count": int(inside.sum()),
                }
            )
    return ForecastQuality(correct, np.square(forecast - happened).sum(axis=1), pd.DataFrame(rows))

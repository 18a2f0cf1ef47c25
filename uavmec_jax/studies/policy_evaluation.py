"""Evaluate one policy on one scenario, beside two heuristics."""

from functools import partial
from typing import Any

import jax
from jaxtyping import Array, Key

from uavmec_jax.env.rollout import Policy, rollouts
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.scenarios.named_scenario import Inventory
from uavmec_jax.studies.evaluation import commonest, device_number, judgement
from uavmec_jax.studies.statistics import mean_interval


def evaluate(policy: Policy, name: str, inventory: Inventory, keys: Key[Array, " D"]) -> list[dict[str, Any]]:
    """How long a policy, oldest-first and earliest-deadline keep one scenario alive on the same draws.

    Returns:
        One dictionary per policy: ``policy``, ``mean`` lifetime in slots with its 95 % interval ``low``, ``high`` over the
        draws, ``shortest``, ``longest``, ``lifetimes``, commonest ``cause``, ``first_device`` (from 1; 0: none fails) and
        ``first_share``, the device that fails first most often.
    """
    rows = []
    for called, player in {name: policy, **{rule: HEURISTICS[rule] for rule in _BESIDE}}.items():
        played = jax.jit(partial(rollouts, player))(inventory.params, inventory.layout, keys)
        judged = judgement(jax.tree.map(lambda leaf: leaf[None], played))
        mean, low, high = mean_interval(judged.lifetime[0])
        share = judged.first_failure[0].mean(axis=0)
        rows.append(
            {
                "policy": called,
                "mean": mean,
                "low": low,
                "high": high,
                "shortest": int(judged.lifetime.min()),
                "longest": int(judged.lifetime.max()),
                "lifetimes": judged.lifetime[0].tolist(),
                "cause": commonest(judged.cause[0]),
                "first_device": device_number(share),
                "first_share": float(share.max()),
            }
        )
    return rows


_BESIDE = ("oldest-first", "earliest-deadline")
"""Rules that a policy is shown beside."""

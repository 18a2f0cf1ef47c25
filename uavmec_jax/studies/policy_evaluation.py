"""Evaluate one policy on one scenario, beside two heuristics."""

from functools import partial
from typing import Any

import jax
from jaxtyping import Array, Key

from uavmec_jax.env.rollout import Policy, rollouts
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.scenarios.named_scenario import NamedScenario
from uavmec_jax.studies.evaluation import device_number, evaluation_result, most_common_cause
from uavmec_jax.studies.statistics import mean_interval


def evaluate_policy(
    policy: Policy, name: str, scenario: NamedScenario, draws: Key[Array, " D"]
) -> list[dict[str, Any]]:
    """Evaluate a policy, oldest-first and earliest-deadline on one scenario and the same draws.

    Returns:
        One dictionary per policy: ``policy``, ``mean`` lifetime in slots with its 95 % interval ``low``, ``high`` over the
        draws, ``shortest``, ``longest``, ``lifetimes``, most common ``cause``, ``first_device`` (from 1; 0: none fails) and
        ``first_share``, the device that fails first most often.
    """
    policies = {name: policy, **{baseline: HEURISTICS[baseline] for baseline in _BASELINES}}
    return [{"policy": called, **_evaluate(player, scenario, draws)} for called, player in policies.items()]


def _evaluate(policy: Policy, scenario: NamedScenario, draws: Key[Array, " D"]) -> dict[str, Any]:
    played = jax.jit(partial(rollouts, policy))(scenario.params, scenario.layout, draws)
    result = evaluation_result(jax.tree.map(lambda leaf: leaf[None], played))
    mean, low, high = mean_interval(result.lifetime[0])
    share = result.first_failure[0].mean(axis=0)
    return {
        "mean": mean,
        "low": low,
        "high": high,
        "shortest": int(result.lifetime.min()),
        "longest": int(result.lifetime.max()),
        "lifetimes": result.lifetime[0].tolist(),
        "cause": most_common_cause(result.cause[0]),
        "first_device": device_number(share),
        "first_share": float(share.max()),
    }


_BASELINES = ("oldest-first", "earliest-deadline")
"""Heuristics that a policy is shown beside."""

"""Evaluate one policy on one scenario, together with two heuristics."""

from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.env.rollout import Policy, rollouts
from uavmec_jax.errors import ArgumentError
from uavmec_jax.planning.fleet_demand import is_alone
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.scenarios.named_scenario import NamedScenario
from uavmec_jax.studies.evaluation_result import EvaluationResult, most_common_cause, most_common_first_device
from uavmec_jax.studies.statistics import mean_interval

_BASELINES = ("oldest-first", "earliest-deadline")
"""Heuristics that a policy is compared with."""


def evaluate_policy(
    policy: Policy, name: str, scenario: NamedScenario, draws: Key[Array, " D"]
) -> list[dict[str, Any]]:
    """Evaluate a policy, oldest-first and earliest-deadline on one scenario and the same draws.

    Args:
        policy: the policy.
        name: name of the policy in the result.
        scenario: where it is evaluated.
        draws: volume draws.

    Returns:
        One dictionary per policy: ``policy``, its name; ``mean`` lifetime in slots with the 95 % interval ``low``, ``high``
        over the draws; ``shortest`` and ``longest`` lifetime; ``lifetimes``, all of them; the most common ``cause`` of
        failure; ``first_device``, the number (from 1) of the device that fails first most often, 0 if none fails; and
        ``first_share``, its share of the first failures. For several UAVs, depots or a horizon also ``censored``, the share
        of the episodes that ``max_slots`` cuts off, and for a horizon ``service``, the mean share of the time to it in which
        the devices are in service, with the interval ``service_low``, ``service_high``.

    Raises:
        ArgumentError: the name is not text.
    """
    if not isinstance(name, str):
        raise ArgumentError(f"name is {name!r}; it should be text")
    policies = {name: policy} | {baseline: HEURISTICS[baseline] for baseline in _BASELINES}
    return [{"policy": label, **_evaluate(each, scenario, draws)} for label, each in policies.items()]


def _evaluate(policy: Policy, scenario: NamedScenario, draws: Key[Array, " D"]) -> dict[str, Any]:
    episodes = jax.jit(partial(rollouts, policy))(scenario.params, scenario.layout, draws)
    result = EvaluationResult.of(jax.tree.map(lambda leaf: leaf[None], episodes))
    lifetimes, share = result.lifetime[0], result.first_failure[0].mean(axis=0)
    mean, low, high = mean_interval(lifetimes)
    return {
        "mean": mean,
        "low": low,
        "high": high,
        "shortest": int(lifetimes.min()),
        "longest": int(lifetimes.max()),
        "lifetimes": lifetimes.tolist(),
        "cause": most_common_cause(result.cause[0]),
        "first_device": most_common_first_device(share),
        "first_share": float(share.max()),
        **_fleet_measures(result, scenario),
    }


def _fleet_measures(result: EvaluationResult, scenario: NamedScenario) -> dict[str, Any]:
    """Return what is measured besides where there is more than the paper's one UAV and its end at the first failure."""
    if is_alone(scenario.layout) and result.service_s is None:
        return {}
    censored = {"censored": float(np.mean(result.cause[0] == Cause.NONE))}
    if result.service_s is None:
        return censored
    mean, low, high = mean_interval(result.service_s[0].astype(float) / float(scenario.params.horizon_s))
    return censored | {"service": mean, "service_low": low, "service_high": high}

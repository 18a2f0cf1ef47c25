"""Evaluate policies, all of them on the same scenarios and volume draws and by the same rollout."""

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import chex
import jax
import numpy as np
import pandas as pd
from jaxtyping import Array, Bool, Int, Key

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.env.drawn_rollouts import rollout_draws
from uavmec_jax.env.generator import ScenarioDistribution
from uavmec_jax.env.rollout import Episode
from uavmec_jax.planning.parallel import heuristic_episodes
from uavmec_jax.studies.evaluation_result import EvaluationResult, PlannerResult
from uavmec_jax.studies.planner_evaluation import evaluate_planners, flatten_draws, planner_columns
from uavmec_jax.studies.schema import Evaluation

_Result = TypeVar("_Result", EvaluationResult, PlannerResult)


def evaluate_learned(
    algorithm: Algorithm, agents: Agent, keys: Key[Array, "A E"], weights: Mapping[str, Any]
) -> dict[str, EvaluationResult]:
    """Evaluate every agent's trained policies on its scenario.

    Args:
        algorithm: makes policies of weights.
        agents: leaves ``[A, ...]``.
        keys: volume draws, from :func:`uavmec_jax.studies.population.evaluation_keys`.
        weights: name -> trained weights, leaves ``[A, ...]``.
    """
    chex.assert_tree_shape_prefix((agents, dict(weights)), keys.shape[:1])
    return {
        name: EvaluationResult.of(_learned_episodes(algorithm, agents, keys, trained))
        for name, trained in weights.items()
    }


# Jitted at module level, so that all shards of a run share one compilation.
@partial(jax.jit, static_argnames="algorithm")
def _learned_episodes(algorithm: Algorithm, agents: Agent, keys: Key[Array, "A E"], weights: Any) -> Episode:
    def episodes_of(agent: Agent, draws: Key[Array, " E"], weights: Any) -> Episode:
        return rollout_draws(algorithm.policy(agent.hyper, weights), agent.scenario, draws)

    return jax.vmap(episodes_of)(agents, keys, weights)


def evaluate_heuristics(agents: Agent, keys: Key[Array, "A E"], names: Iterable[str]) -> dict[str, EvaluationResult]:
    """Evaluate heuristics, by their names in :data:`FLEET_HEURISTICS`, on every agent's scenario.

    Args:
        agents: leaves ``[A, ...]``.
        keys: volume draws.
        names: which heuristics.
    """
    names = tuple(names)
    if not names:
        return {}
    if isinstance(agents.scenario, ScenarioDistribution):
        params, layouts, draws = flatten_draws(agents.scenario, keys)
        episodes = heuristic_episodes(names, params, layouts, draws[:, None])
        episodes = jax.tree.map(lambda leaf: leaf.reshape(len(names), *keys.shape, *leaf.shape[3:]), episodes)
    else:
        episodes = heuristic_episodes(names, agents.scenario.params, agents.scenario.layout, keys)
    return {
        name: EvaluationResult.of(jax.tree.map(lambda leaf, k=k: leaf[k], episodes)) for k, name in enumerate(names)
    }


@dataclass(frozen=True)
class DistinctScenarios:
    """Which of ``A`` agents have the same scenario and draws; heuristics and planners are evaluated once for them.

    Attributes:
        first: position of the first agent of each of ``S`` scenarios.
        scenario: position of each agent's scenario.
    """

    first: Int[np.ndarray, " S"]
    scenario: Int[np.ndarray, " A"]

    @classmethod
    def of(cls, columns: pd.DataFrame) -> "DistinctScenarios":
        """Find the distinct rows among the columns that define an agent's scenario and draws."""
        scenario = columns.groupby(list(columns), sort=False).ngroup().to_numpy()
        return cls(first=np.unique(scenario, return_index=True)[1], scenario=scenario)

    def longest(self, lifetimes: Int[np.ndarray, "A *draws"]) -> Int[np.ndarray, "S *draws"]:
        """Return the longest of the agents' lifetimes in each scenario."""
        longest = np.zeros((len(self.first), *lifetimes.shape[1:]), lifetimes.dtype)
        np.maximum.at(longest, self.scenario, lifetimes)
        return longest

    def to_agents(self, result: _Result) -> _Result:
        """Return the result of ``A`` agents from that of ``S`` scenarios."""
        fields = {name: array[self.scenario] for name, array in vars(result).items() if array is not None}
        return replace(result, **fields)


def evaluate_all(
    agents: Agent,
    keys: Key[Array, "A E"],
    learned: dict[str, EvaluationResult],
    distinct: DistinctScenarios,
    settings: Evaluation,
    clairvoyant: Bool[np.ndarray, " A"] | None = None,
) -> tuple[dict[str, Any], dict[str, np.ndarray], float]:
    """Evaluate heuristics and planners, and put their results beside those of the trained policies.

    Args:
        agents: leaves ``[A, ...]``.
        keys: volume draws.
        learned: results of the trained policies, from :func:`evaluate_learned`.
        distinct: which agents have the same scenario and draws.
        settings: which heuristics and planners.
        clairvoyant: agents that beam and bound are evaluated for; ``None``: all.

    Returns:
        Columns of the tidy table; the fields of all results by ``policy/field``; and the seconds that the planners took.
    """
    firsts, draws = jax.tree.map(lambda leaf: leaf[distinct.first], (agents, keys))
    heuristics = evaluate_heuristics(firsts, draws, settings.baselines)
    lifetimes = [distinct.longest(result.lifetime) for result in learned.values()]
    lifetimes += [result.lifetime for result in heuristics.values()]
    started = time.perf_counter()
    chosen = None if clairvoyant is None else clairvoyant[distinct.first]
    planners = evaluate_planners(firsts, draws[:, :-1], settings, lifetimes, chosen)
    seconds = time.perf_counter() - started
    planners = {name: distinct.to_agents(result) for name, result in planners.items()}
    policies = learned | {name: distinct.to_agents(result) for name, result in heuristics.items()}
    columns: dict[str, Any] = {}
    for name, result in policies.items():
        columns |= result.columns(name)
    fields = {
        f"{policy.replace('-', '_')}/{name}": array
        for policy, result in [*policies.items(), *planners.items()]
        for name, array in vars(result).items()
        if array is not None
    }
    return columns | planner_columns(policies, planners), fields, seconds

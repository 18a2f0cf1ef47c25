"""Judge policies: every one plays the same layouts and the same volume draws through the same rollout."""

import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Key

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.env.dynamics import Cause
from uavmec_jax.env.generator import ScenarioDistribution, scenario_from_draw
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode, rollout_draws
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.planning.beam import horizon
from uavmec_jax.planning.parallel import beam_episodes, bound_scenarios, heuristic_episodes, rollout_planner_episodes
from uavmec_jax.studies.schema import Evaluation


@dataclass(frozen=True)
class EvaluationResult:
    """How one policy did on ``A`` agents' scenarios; ``D`` held-out draws and the fixed one behind them.

    Attributes:
        lifetime: ``[A, D + 1]`` int32 slots.
        cause: ``[A, D + 1]`` int8, a :class:`Cause`.
        first_failure: ``[A, D + 1, n]`` f32, share of each device in the first failure of each episode.
    """

    lifetime: np.ndarray
    cause: np.ndarray
    first_failure: np.ndarray

    @property
    def mean_lifetime(self) -> np.ndarray:
        """``[A]`` mean over the held-out draws."""
        return self.lifetime[:, :-1].mean(axis=1)

    @property
    def first_failure_share(self) -> np.ndarray:
        """``[A, n]`` how often each device is the first to fail, over the held-out draws."""
        return self.first_failure[:, :-1].mean(axis=1)

    def columns(self, policy: str) -> dict[str, Any]:
        """The evaluation_result as columns of the tidy table, named after the policy."""
        prefix = policy.replace("-", "_")
        often = self.first_failure_share
        fixed = self.first_failure[:, -1]
        return {
            f"{prefix}_lifetime": self.mean_lifetime,
            f"{prefix}_lifetime_fixed": self.lifetime[:, -1],
            f"{prefix}_cause": [most_common_cause(causes) for causes in self.cause[:, :-1]],
            f"{prefix}_cause_fixed": [Cause(cause).name.lower() for cause in self.cause[:, -1]],
            f"{prefix}_first_device": [device_number(row) for row in often],
            f"{prefix}_first_share": often.max(axis=1),
            f"{prefix}_first_devices_fixed": [" ".join(str(i + 1) for i in np.flatnonzero(row)) for row in fixed],
        }


def most_common_cause(causes: np.ndarray) -> str:
    """Name of the most frequent cause."""
    return Cause(int(np.bincount(causes).argmax())).name.lower()


def device_number(share: np.ndarray) -> int:
    """Number (from 1) of the device that is first most often; 0 if none ever fails."""
    return int(share.argmax()) + 1 if share.max() > 0 else 0


def evaluate_learned(
    algorithm: Algorithm, agents: Agent, keys: Key[Array, "A D"], weights: Mapping[str, Any]
) -> dict[str, EvaluationResult]:
    """Play every agent's learned policies on its scenario.

    Args:
        algorithm: makes policies from weights.
        agents: leaves ``[A, ...]``.
        keys: ``[A, D + 1]`` volume draws, from :func:`uavmec_jax.studies.study.evaluation_keys`.
        weights: name -> trained weights, leaves ``[A, ...]``.
    """
    return {
        name: evaluation_result(_play_learned(algorithm, agents, keys, trained)) for name, trained in weights.items()
    }


def evaluate_heuristics(agents: Agent, keys: Key[Array, "A D"], names: Iterable[str]) -> dict[str, EvaluationResult]:
    """Play heuristics, by their names in :data:`HEURISTICS`, on every agent's scenario and ``[A, D + 1]`` draws."""
    names = tuple(names)
    if not names:
        return {}
    if isinstance(agents.scenario, ScenarioDistribution):
        params, layouts, flat = flatten_draws(agents.scenario, keys)
        played = heuristic_episodes(names, params, layouts, flat[:, None])
        played = jax.tree.map(lambda leaf: leaf.reshape(len(names), *keys.shape, *leaf.shape[3:]), played)
    else:
        played = heuristic_episodes(names, agents.scenario.params, agents.scenario.layout, keys)
    return {name: evaluation_result(jax.tree.map(lambda leaf, k=k: leaf[k], played)) for k, name in enumerate(names)}


def evaluation_result(episode: Episode) -> EvaluationResult:
    """Episodes, leaves ``[A, D + 1, ...]``, as a evaluation_result."""
    return EvaluationResult(
        lifetime=np.asarray(episode.length),
        cause=np.asarray(episode.cause, np.int8),
        first_failure=np.asarray(episode.first_failure),
    )


@dataclass(frozen=True)
class PlannerResult:
    """How a planner did on the first ``P`` held-out draws of ``A`` agents' scenarios.

    Attributes:
        lifetime: ``[A, P]`` int32 slots; of ``bound`` the lifetime that no policy passes.
        cause: ``[A, P]`` int8, a :class:`Cause`; ``None`` for the bound.
        first_failure: ``[A, P, n]`` f32; ``None`` for the bound.
    """

    lifetime: np.ndarray
    cause: np.ndarray | None = None
    first_failure: np.ndarray | None = None


def evaluate_planners(
    agents: Agent, keys: Key[Array, "A D"], settings: Evaluation, lifetimes: list[np.ndarray]
) -> dict[str, PlannerResult]:
    """Play the planners, and bound what any policy can reach, on the first held-out draws.

    Args:
        agents: leaves ``[A, ...]``.
        keys: ``[A, D]`` the held-out draws.
        settings: which planners, how many draws, how wide.
        lifetimes: ``[A, D]`` of policies that played the same draws; the bound starts from the longest.
    """
    draws = min(settings.planner_draws, keys.shape[1])
    shape = (keys.shape[0], draws)
    params, layouts, keys = flatten_draws(agents.scenario, keys[:, :draws])
    slots = horizon(params, layouts)
    judged = {}
    if "rollout" in settings.planners:
        judged["rollout"] = _planned(
            rollout_planner_episodes(params, layouts, keys, slots=slots, samples=settings.rollout_samples)[1], shape
        )
    if "beam" in settings.planners:
        judged["beam"] = _planned(
            beam_episodes(params, layouts, keys, slots=slots, width=settings.beam_width)[1], shape
        )
    if "bound" in settings.planners:
        lifetimes = [*lifetimes, *(evaluation_result.lifetime for evaluation_result in judged.values())]
        reached = np.max([np.ones(shape), *(life[:, :draws] for life in lifetimes)], axis=0)
        found = bound_scenarios(params, layouts, keys, reached.reshape(-1), slots=slots)
        judged["bound"] = PlannerResult(lifetime=found.reshape(shape))
    return judged


def _planned(episodes: Episode, shape: tuple[int, int]) -> PlannerResult:
    return PlannerResult(
        lifetime=np.asarray(episodes.length).reshape(shape),
        cause=np.asarray(episodes.cause, np.int8).reshape(shape),
        first_failure=np.asarray(episodes.first_failure).reshape(*shape, -1),
    )


def planned_columns(
    evaluation_results: Mapping[str, EvaluationResult], planned: Mapping[str, PlannerResult]
) -> dict[str, np.ndarray | list]:
    """Columns of the tidy table: mean lifetimes of everyone on the planners' draws, and who fails first under them."""
    if not planned:
        return {}
    draws = next(iter(planned.values())).lifetime.shape[1]
    columns: dict[str, np.ndarray | list] = {}
    everyone: Mapping[str, EvaluationResult | PlannerResult] = {**evaluation_results, **planned}
    for name, anyone in everyone.items():
        columns[f"{name.replace('-', '_')}_planned"] = anyone.lifetime[:, :draws].mean(axis=1)
    for name, judged in planned.items():
        if judged.cause is not None and judged.first_failure is not None:
            often = judged.first_failure.mean(axis=1)
            columns[f"{name}_cause"] = [most_common_cause(causes) for causes in judged.cause]
            columns[f"{name}_first_device"] = [device_number(row) for row in often]
            columns[f"{name}_first_share"] = often.max(axis=1)
    return columns


@dataclass(frozen=True)
class DistinctScenarios:
    """Which of ``A`` agents play the same scenario and draws, so that what nobody learned is played once for all of them.

    Attributes:
        first: ``[S]`` the first agent of each scenario.
        scenario: ``[A]`` the scenario of each agent.
    """

    first: np.ndarray
    scenario: np.ndarray

    @classmethod
    def of(cls, played: pd.DataFrame) -> "DistinctScenarios":
        """From the columns that say what is played, one row per agent."""
        scenario = played.groupby(list(played), sort=False).ngroup().to_numpy()
        return cls(first=np.unique(scenario, return_index=True)[1], scenario=scenario)

    def longest(self, lifetimes: np.ndarray) -> np.ndarray:
        """``[S, ...]`` the longest of ``[A, ...]`` lifetimes in each scenario."""
        found = np.zeros((len(self.first), *lifetimes.shape[1:]), lifetimes.dtype)
        np.maximum.at(found, self.scenario, lifetimes)
        return found

    def to_agents(self, evaluation_result: Any) -> Any:
        """A evaluation_result of ``S`` scenarios as one of ``A`` agents."""
        leaves = {name: leaf for name, leaf in vars(evaluation_result).items() if leaf is not None}
        return replace(evaluation_result, **{name: leaf[self.scenario] for name, leaf in leaves.items()})


def evaluate_all(
    agents: Agent,
    keys: Key[Array, "A D"],
    learned: dict[str, EvaluationResult],
    distinct: DistinctScenarios,
    settings: Evaluation,
) -> tuple[dict[str, Any], dict[str, np.ndarray], float]:
    """Judge heuristics and planners beside the learned policies.

    Args:
        agents: leaves ``[A, ...]``.
        keys: ``[A, D + 1]`` volume draws.
        learned: from :func:`evaluate_learned`.
        distinct: which agents play the same.
        settings: who plays.

    Returns:
        Columns of the tidy table, every episode by ``policy/field``, and the seconds that the planners took.
    """
    once, draws = jax.tree.map(lambda leaf: leaf[distinct.first], (agents, keys))
    heuristics = evaluate_heuristics(once, draws, settings.baselines)
    reached = [distinct.longest(judged.lifetime) for judged in learned.values()]
    reached += [judged.lifetime for judged in heuristics.values()]
    started = time.perf_counter()
    planned = {
        name: distinct.to_agents(judged)
        for name, judged in evaluate_planners(once, draws[:, :-1], settings, reached).items()
    }
    planning = time.perf_counter() - started
    evaluation_results = learned | {name: distinct.to_agents(judged) for name, judged in heuristics.items()}
    columns = {
        name: values for policy, judged in evaluation_results.items() for name, values in judged.columns(policy).items()
    }
    everyone: dict[str, EvaluationResult | PlannerResult] = {**evaluation_results, **planned}
    evaluation = {
        f"{policy.replace('-', '_')}/{name}": values
        for policy, anyone in everyone.items()
        for name, values in asdict(anyone).items()
        if values is not None
    }
    return columns | planned_columns(evaluation_results, planned), evaluation, planning


# Jitted here and not inside `judge`, so that the blocks of a run share one compilation.
@partial(jax.jit, static_argnames="algorithm")
def _play_learned(algorithm: Algorithm, agents: Agent, keys: Key[Array, "A D"], weights: Any) -> Episode:
    def one(agent: Agent, draws: Key[Array, " D"], weights: Any) -> Episode:
        return rollout_draws(algorithm.policy(agent.hyper, weights), agent.scenario, draws)

    return jax.vmap(one)(agents, keys, weights)


def flatten_draws(
    plays: Scenario | ScenarioDistribution, keys: Key[Array, "A D"]
) -> tuple[Params, Layout, Key[Array, " AD"]]:
    """What ``A`` agents play in each of ``D`` draws, and the draws, leaves ``[A * D, ...]``.

    Args:
        plays: leaves ``[A, ...]``.
        keys: draws.
    """
    if isinstance(plays, Scenario):
        each = jax.tree.map(lambda leaf: jnp.repeat(leaf, keys.shape[1], axis=0), plays)
    else:
        drawn = _draw_all(plays, keys)
        each = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), drawn)
    return each.params, each.layout, keys.reshape(-1)


_draw_all = jax.jit(jax.vmap(jax.vmap(scenario_from_draw, (None, 0))))

"""Evaluate planners, and the upper bound on every policy, on the draws that policies are evaluated on."""

from collections.abc import Mapping

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key

from uavmec_jax.agents.algorithm import Agent
from uavmec_jax.env.generator import ScenarioDistribution, scenario_from_draw
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.planning.fleet_demand import horizon
from uavmec_jax.planning.parallel import beam_episodes, bound_scenarios, rollout_planner_episodes
from uavmec_jax.studies.evaluation_result import EvaluationResult, PlannerResult
from uavmec_jax.studies.schema import Evaluation


def evaluate_planners(
    agents: Agent, keys: Key[Array, "A D"], settings: Evaluation, lifetimes: list[Int[np.ndarray, "A E"]]
) -> dict[str, PlannerResult]:
    """Evaluate the planners and the bound on the first held-out draws.

    Args:
        agents: leaves ``[A, ...]``.
        keys: held-out draws.
        settings: which planners, on how many draws, and how wide they search.
        lifetimes: lifetimes of policies on these draws and any more behind them; the bound cannot be below them.
    """
    draws = min(settings.planner_draws, keys.shape[1])
    shape = (keys.shape[0], draws)
    params, layouts, keys = flatten_draws(agents.scenario, keys[:, :draws])
    slots = horizon(params, layouts)
    results = {}
    if "rollout" in settings.planners:
        _, episodes = rollout_planner_episodes(params, layouts, keys, slots=slots, samples=settings.rollout_samples)
        results["rollout"] = PlannerResult.of(episodes, shape)
    if "beam" in settings.planners:
        _, episodes = beam_episodes(params, layouts, keys, slots=slots, width=settings.beam_width)
        results["beam"] = PlannerResult.of(episodes, shape)
    if "bound" in settings.planners:
        reached = [*lifetimes, *(result.lifetime for result in results.values())]
        at_least = np.max([np.ones(shape), *(lifetime[:, :draws] for lifetime in reached)], axis=0)
        bounds = bound_scenarios(params, layouts, keys, at_least.reshape(-1), slots=slots)
        results["bound"] = PlannerResult(lifetime=bounds.reshape(shape))
    return results


def planner_columns(
    results: Mapping[str, EvaluationResult], planner_results: Mapping[str, PlannerResult]
) -> dict[str, np.ndarray | list]:
    """Return columns of the tidy table: mean lifetimes on the planners' draws, and how the planners' episodes end.

    Args:
        results: policies.
        planner_results: planners and the bound; without any there are no columns.
    """
    if not planner_results:
        return {}
    draws = next(iter(planner_results.values())).lifetime.shape[1]
    lifetimes = {name: result.lifetime for name, result in results.items()}
    lifetimes |= {name: result.lifetime for name, result in planner_results.items()}
    columns: dict[str, np.ndarray | list] = {
        f"{name.replace('-', '_')}_planned": lifetime[:, :draws].mean(axis=1) for name, lifetime in lifetimes.items()
    }
    for name, result in planner_results.items():
        columns |= result.columns(name)
    return columns


def flatten_draws(
    scenarios: Scenario | ScenarioDistribution, keys: Key[Array, "A D"]
) -> tuple[Params, Layout, Key[Array, " AD"]]:
    """Return parameters, layout and volume draw of every episode, leaves ``[A * D, ...]``.

    Args:
        scenarios: of each agent, leaves ``[A, ...]``; from a distribution every draw is a scenario of its own.
        keys: draws of each agent.
    """
    chex.assert_tree_shape_prefix(scenarios, keys.shape[:1])
    if isinstance(scenarios, Scenario):
        episodes = jax.tree.map(lambda leaf: jnp.repeat(leaf, keys.shape[1], axis=0), scenarios)
    else:
        drawn = _scenarios_from_draws(scenarios, keys)
        episodes = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), drawn)
    return episodes.params, episodes.layout, keys.reshape(-1)


_scenarios_from_draws = jax.jit(jax.vmap(jax.vmap(scenario_from_draw, (None, 0))))

"""Evaluate planners, and the upper bound on every policy, on the draws that policies are evaluated on."""

from collections.abc import Mapping

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Key

from uavmec_jax.agents.algorithm import Agent
from uavmec_jax.env.generator import ScenarioDistribution, scenario_from_draw
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.planning.fleet_demand import planned_slots
from uavmec_jax.planning.parallel import beam_episodes, bound_scenarios, rollout_planner_episodes
from uavmec_jax.studies.evaluation_result import EvaluationResult, PlannerResult
from uavmec_jax.studies.schema import CLAIRVOYANT, Evaluation


def evaluate_planners(
    agents: Agent,
    keys: Key[Array, "A D"],
    settings: Evaluation,
    lifetimes: list[Int[np.ndarray, "A E"]],
    clairvoyant: Bool[np.ndarray, " A"] | None = None,
) -> dict[str, PlannerResult]:
    """Evaluate the planners and the bound on the first held-out draws.

    Args:
        agents: leaves ``[A, ...]``.
        keys: held-out draws.
        settings: which planners, on how many draws, and how wide they search.
        lifetimes: lifetimes of policies on these draws and any more after them; the bound cannot be below them.
        clairvoyant: agents that beam and bound are evaluated for; ``None``: all.
    """
    draws = min(settings.planner_draws, keys.shape[1])
    keys = keys[:, :draws]
    results: dict[str, PlannerResult] = {}
    if "rollout" in settings.planners:
        params, layouts, flat = flatten_draws(agents.scenario, keys)
        slots, samples = planned_slots(params, layouts), settings.rollout_samples
        _, episodes = rollout_planner_episodes(params, layouts, flat, slots=slots, samples=samples)
        results["rollout"] = PlannerResult.of(episodes, draws)
    reached = [lifetime[:, :draws] for lifetime in (*lifetimes, *(result.lifetime for result in results.values()))]
    if clairvoyant is None or clairvoyant.all():
        return results | _evaluate_clairvoyant(agents, keys, settings, reached)
    if clairvoyant.any():
        agents, keys = jax.tree.map(lambda leaf: leaf[clairvoyant], (agents, keys))
        found = _evaluate_clairvoyant(agents, keys, settings, [lifetime[clairvoyant] for lifetime in reached])
    else:
        found = {name: PlannerResult.of_none(name, agents.scenario.params, draws) for name in CLAIRVOYANT}
    return results | {name: found[name].at(clairvoyant) for name in settings.planners if name in found}


def _evaluate_clairvoyant(
    agents: Agent, keys: Key[Array, "A P"], settings: Evaluation, reached: list[Int[np.ndarray, "A P"]]
) -> dict[str, PlannerResult]:
    """Evaluate the beam and the bound, which is not below the lifetimes that policies ``reached``."""
    results: dict[str, PlannerResult] = {}
    if not set(CLAIRVOYANT) & set(settings.planners):
        return results
    shape = keys.shape
    params, layouts, keys = flatten_draws(agents.scenario, keys)
    slots = planned_slots(params, layouts)
    if "beam" in settings.planners:
        _, episodes = beam_episodes(params, layouts, keys, slots=slots, width=settings.beam_width)
        results["beam"] = PlannerResult.of(episodes, shape[1])
        reached = [*reached, results["beam"].lifetime]
    if "bound" in settings.planners:
        at_least = np.max([np.ones(shape), *reached], axis=0)
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
    columns: dict[str, np.ndarray | list] = {
        f"{name.replace('-', '_')}_planned": result.lifetime[:, :draws].mean(axis=1) for name, result in results.items()
    }
    columns |= {f"{name}_planned": result.mean_lifetime for name, result in planner_results.items()}
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

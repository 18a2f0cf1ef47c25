"""The plan for one scenario: tours, how far they are from the upper bound, a forecast, and what repairs would bring."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from uavmec_jax.env.checks import check_range
from uavmec_jax.env.dynamics import Cause
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.measures import ServiceMeasures, measure
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode, Trace, tour_policy, trace
from uavmec_jax.env.scenario_checks import check_scenario
from uavmec_jax.planning import beam
from uavmec_jax.planning.changes import WhatIf, layouts_to_try, rank_changes
from uavmec_jax.planning.fleet_deadlines import earliest_deadline
from uavmec_jax.planning.fleet_demand import is_alone, planned_slots
from uavmec_jax.planning.forecast import MAX_SAMPLES, Forecast
from uavmec_jax.planning.heuristics import FLEET_HEURISTICS, HEURISTICS
from uavmec_jax.planning.parallel import (
    beam_episodes,
    bound_scenarios,
    heuristic_episodes,
    policy_episodes,
    rollout_planner_episodes,
    spread,
)
from uavmec_jax.planning.rollout_planner import SAMPLES
from uavmec_jax.planning.service_bound import service_bound

WIDTH = 256
"""States that the beam keeps for one UAV without depots: one scenario can afford more than a study (:data:`beam.WIDTH`)."""

PLANNED_SLOTS = 64
"""Slots to plan for by default where depots let UAVs fly on for ever: ten hours or so."""

_MOST_RECORDED = 4096
"""Slots of a tour to a horizon that are recorded."""


@dataclass(frozen=True)
class Plan:
    """The result of planning for one scenario with ``D`` volume draws; NumPy arrays.

    Attributes:
        params: scenario parameters.
        layout: the devices, the UAVs and the depots.
        lifetimes: ``[D]`` slots by policy: the heuristics, ``rollout``, and ``beam``, which is clairvoyant. Where the end is
            a horizon, there is no ``beam``, and they are the slots until then.
        bound: ``[D]`` slots, certified upper bounds on the lifetime of any policy; at most ``max_slots``; ``None`` where the
            end is a horizon.
        forecast: the forecast under the rollout planner.
        tours: slot by slot, those of ``rollout`` and ``beam`` on the first draw.
        what_if: every repair and removal of one device, the largest gain first: under the rollout planner, for fleets and
            where the end is a horizon under the earliest-deadline rule.
        measures: ``[D]``, of the rollout planner's tours; averages over time where the end is a horizon, else over slots.
        service: where the end is a horizon, ``[D]`` by policy: the share of the time to it in which the devices are in
            service, weighted by priority; else ``None``.
        service_bound: an upper bound on that share (:func:`uavmec_jax.planning.service_bound.service_bound`).
    """

    params: Params
    layout: Layout
    lifetimes: Mapping[str, Int[np.ndarray, " D"]]
    bound: Int[np.ndarray, " D"] | None
    forecast: Forecast
    tours: Mapping[str, Trace]
    what_if: tuple[WhatIf, ...]
    measures: ServiceMeasures
    service: Mapping[str, Float[np.ndarray, " D"]] | None = None
    service_bound: float | None = None

    @property
    def as_in_paper(self) -> bool:
        """Whether the scenario is one of the paper's: one UAV, no depots, and the first failure is the end."""
        return is_alone(self.layout) and self.service is None


def make_plan(
    params: Params, layout: Layout, draws: Key[Array, " D"], *, width: int | None = None, samples: int = SAMPLES
) -> Plan:
    """Plan for one scenario.

    With ``end = "horizon"``, what counts is the time in service, not the lifetime: the rules and the rollout planner are
    compared by it, and there is no beam.

    Args:
        params: scenario parameters.
        layout: the devices, the UAVs and the depots.
        draws: volume draws; policies are evaluated on all of them, the tours are those of the first.
        width: states that the beam keeps; by default :data:`WIDTH`, for fleets as many as in studies.
        samples: futures that the rollout planner simulates per candidate.

    Raises:
        ArgumentError: a parameter, a value of the layout or a number is out of range, or there is no draw; one line.
    """
    check_scenario(params, layout)
    check_range("the number of draws", len(draws), ge=1, whole=True)
    check_range("samples", samples, ge=1, le=MAX_SAMPLES, whole=True)
    if width is not None:
        check_range("width", width, ge=1, whole=True)
    width = (WIDTH if is_alone(layout) else beam.WIDTH) if width is None else width
    count, goes_on = draws.shape[0], params.end == "horizon"
    per_draw, unchanged = _repeat(params, count), _repeat(layout, count)
    if plans_changes := is_alone(layout) and not goes_on:
        # One call of the rollout planner simulates the scenario as it is and with every change.
        per_layout, layouts, all_draws = _with_changes(params, layout, draws)
    else:
        per_layout, layouts, all_draws = per_draw, unchanged, draws
    slots = min(int(params.max_slots), _MOST_RECORDED) if goes_on else planned_slots(per_layout, layouts)
    planned, tried = rollout_planner_episodes(per_layout, layouts, all_draws, slots=slots, samples=samples)
    tours, episodes = {"rollout": planned[:count]}, _heuristics(params, layout, draws)
    episodes["rollout"] = jax.tree.map(lambda leaf: np.asarray(leaf[:count]), tried)
    bound = None
    if not goes_on:
        tours["beam"], episodes["beam"] = beam_episodes(per_draw, unchanged, draws, slots=slots, width=width)
        longest = np.max([episode.length for episode in episodes.values()], axis=0)
        bound = bound_scenarios(per_draw, unchanged, draws, longest, slots=slots)
    if not plans_changes:
        per_layout, layouts, all_draws = _with_changes(params, layout, draws)
        tried = policy_episodes(earliest_deadline, per_layout, layouts, all_draws[:, None])
        tried = jax.tree.map(lambda leaf: leaf[:, 0], tried)
    by_change = jax.tree.map(lambda leaf: leaf.reshape(-1, count, *leaf.shape[1:]), tried)
    return Plan(
        params=params,
        layout=jax.tree.map(np.asarray, layout),
        lifetimes={name: np.asarray(episode.length) for name, episode in episodes.items()},
        bound=bound,
        forecast=Forecast.of(episodes["rollout"]),
        tours={name: _started_slots(_trace(params, layout, draws[0], tour[0])) for name, tour in tours.items()},
        what_if=rank_changes(params, layout, by_change, float(params.horizon_s)),
        measures=jax.tree.map(np.asarray, _measures(per_draw, unchanged, draws, tours["rollout"])),
        service=_shares(params, episodes) if goes_on else None,
        service_bound=float(service_bound(params, layout)) if goes_on else None,
    )


def _heuristics(params: Params, layout: Layout, draws: Key[Array, " D"]) -> dict[str, Episode]:
    """Return the episodes of the heuristics by name, leaves ``[D, ...]``."""
    names = tuple(HEURISTICS if layout.n_uavs == 1 else FLEET_HEURISTICS)
    episodes = heuristic_episodes(names, *_repeat((params, layout), 1), draws[None])
    return {name: jax.tree.map(lambda leaf, k=k: np.asarray(leaf[k, 0]), episodes) for k, name in enumerate(names)}


def _shares(params: Params, episodes: Mapping[str, Episode]) -> dict[str, Float[np.ndarray, " D"]]:
    """Return the shares of the time to the horizon in which the devices are in service."""
    return {name: np.asarray(episode.service_s, float) / float(params.horizon_s) for name, episode in episodes.items()}


def _with_changes(params: Params, layout: Layout, draws: Key[Array, " D"]) -> tuple[Params, Layout, Key[Array, " LD"]]:
    """Return the layout as it is and with every change, each with every draw: leaves ``[L * D, ...]``."""
    layouts = layouts_to_try(params, layout)
    count = layouts.capacity.shape[0]
    repeated = jax.tree.map(lambda leaf: jnp.repeat(leaf, len(draws), axis=0), layouts)
    return _repeat(params, count * len(draws)), repeated, jnp.tile(draws, count)


def _repeat(tree: Any, count: int) -> Any:
    """Repeat every leaf along a new leading axis."""
    return jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf)[None], count, axis=0), tree)


@jax.jit
def _trace(params: Params, layout: Layout, draw: Key[Array, ""], tour: Int[Array, "H *K"]) -> Trace:
    """Simulate a tour on one volume draw, slot by slot."""
    return trace(tour_policy(tour), params, layout, draw, tour.shape[0])


@jax.jit
def _measures(params: Params, layouts: Layout, draws: Key[Array, " D"], tours: Int[Array, "D H *K"]) -> ServiceMeasures:
    """Simulate tours, each on its draw, and measure them; leaves ``[D]``."""

    def measured(params: Params, layout: Layout, draw: Key[Array, ""], tour: Int[Array, "H *K"]) -> ServiceMeasures:
        return measure(params, layout, _trace(params, layout, draw, tour), by_time=params.end == "horizon")

    return spread(measured, params, layouts, draws, tours)


def _started_slots(slots: Trace) -> Trace:
    """Return the slots that were started, without one that the UAV's energy did not pay for; NumPy leaves."""
    started = np.asarray(slots.played) & ~(np.asarray(slots.outcome.cause) == Cause.UAV)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[started], slots)

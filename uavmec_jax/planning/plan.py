"""The plan for one scenario: tours, how far they are from the upper bound, a forecast, and what repairs would bring."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Trace, tour_policy, trace
from uavmec_jax.planning.beam import horizon
from uavmec_jax.planning.changes import WhatIf, every_change, rank_changes
from uavmec_jax.planning.fleet_deadlines import earliest_deadline
from uavmec_jax.planning.forecast import Forecast
from uavmec_jax.planning.heuristics import FLEET_HEURISTICS, HEURISTICS
from uavmec_jax.planning.parallel import (
    beam_episodes,
    bound_scenarios,
    heuristic_episodes,
    policy_episodes,
    rollout_planner_episodes,
)
from uavmec_jax.planning.rollout_planner import SAMPLES

WIDTH = 256
"""States that the beam keeps: one scenario can afford more than a study (:data:`uavmec_jax.planning.beam.WIDTH`)."""


@dataclass(frozen=True)
class Plan:
    """The result of planning for one scenario with ``D`` volume draws; NumPy arrays.

    Attributes:
        params: scenario parameters.
        layout: the devices.
        lifetimes: ``[D]`` slots by policy: the heuristics, ``rollout``, and ``beam``, which is clairvoyant.
        bound: ``[D]`` slots, certified upper bounds on the lifetime of any policy; at most ``max_slots``.
        forecast: the forecast under the rollout planner.
        tours: slot by slot, those of ``rollout`` and ``beam`` on the first draw.
        what_if: every repair and removal of one device, the largest gain first: under the rollout planner, for a fleet
            under the earliest-deadline rule.
    """

    params: Params
    layout: Layout
    lifetimes: Mapping[str, Int[np.ndarray, " D"]]
    bound: Int[np.ndarray, " D"]
    forecast: Forecast
    tours: Mapping[str, Trace]
    what_if: tuple[WhatIf, ...]


def make_plan(
    params: Params, layout: Layout, draws: Key[Array, " D"], *, width: int = WIDTH, samples: int = SAMPLES
) -> Plan:
    """Plan for one scenario.

    Args:
        params: scenario parameters.
        layout: the devices.
        draws: volume draws; lifetimes are evaluated on all of them, the tours are those of the first.
        width: states that the beam keeps.
        samples: futures that the rollout planner simulates per candidate.
    """
    count = draws.shape[0]
    if layout.n_uavs == 1:
        # One call of the rollout planner simulates the scenario as it is and with every change.
        layouts, per_layout, all_draws = _with_changes(params, layout, draws)
    else:
        layouts, per_layout, all_draws = _repeat(layout, count), _repeat(params, count), draws
    per_draw, unchanged = _repeat(params, count), jax.tree.map(lambda leaf: leaf[:count], layouts)
    slots = horizon(per_layout, layouts)
    tours, episodes = rollout_planner_episodes(per_layout, layouts, all_draws, slots=slots, samples=samples)
    rollout = jax.tree.map(lambda leaf: np.asarray(leaf[:count]), episodes)
    beam_tours, beam = beam_episodes(per_draw, unchanged, draws, slots=slots, width=width)
    names = tuple(HEURISTICS if layout.n_uavs == 1 else FLEET_HEURISTICS)
    simple = heuristic_episodes(names, *_repeat((params, layout), 1), draws[None])
    lifetimes = {name: np.asarray(simple.length[k, 0]) for k, name in enumerate(names)}
    lifetimes |= {"rollout": rollout.length, "beam": np.asarray(beam.length)}
    longest = np.max(list(lifetimes.values()), axis=0)
    if layout.n_uavs > 1:
        layouts, per_layout, all_draws = _with_changes(params, layout, draws)
        episodes = policy_episodes(earliest_deadline, per_layout, layouts, all_draws[:, None])
    by_change = np.asarray(episodes.length).reshape(-1, count)
    return Plan(
        params=params,
        layout=jax.tree.map(np.asarray, layout),
        lifetimes=lifetimes,
        bound=bound_scenarios(per_draw, unchanged, draws, longest, slots=slots),
        forecast=Forecast.of(rollout),
        tours={
            name: _started_slots(_trace(params, layout, draws[0], tour))
            for name, tour in (("rollout", tours[0]), ("beam", beam_tours[0]))
        },
        what_if=rank_changes(layout, by_change[1:], by_change[0]),
    )


def _with_changes(params: Params, layout: Layout, draws: Key[Array, " D"]) -> tuple[Layout, Params, Key[Array, " LD"]]:
    """Return the layout as it is and with every change, each with every draw: leaves ``[L * D, ...]``."""
    layouts = [layout, *every_change(layout)]
    repeated = jax.tree.map(lambda *leaves: jnp.repeat(jnp.stack(leaves), len(draws), axis=0), *layouts)
    return repeated, _repeat(params, len(layouts) * len(draws)), jnp.tile(draws, len(layouts))


def _repeat(tree: Any, count: int) -> Any:
    """Repeat every leaf along a new leading axis."""
    return jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf)[None], count, axis=0), tree)


@jax.jit
def _trace(params: Params, layout: Layout, draw: Key[Array, ""], tour: Int[Array, " H"]) -> Trace:
    """Simulate a tour on one volume draw, slot by slot."""
    return trace(tour_policy(tour), params, layout, draw, tour.shape[0])


def _started_slots(slots: Trace) -> Trace:
    """Return the slots that were started, without one that the UAV's energy did not pay for; NumPy leaves."""
    started = np.asarray(slots.played) & ~(np.asarray(slots.outcome.cause) == Cause.UAV)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[started], slots)

"""The outlook of one scenario: who lives how long, by which tour, what fails first, and what a repair would bring."""

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
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.parallel import bound_all, play_beam, play_heuristics, play_rollout
from uavmec_jax.planning.rollout_planner import SAMPLES

WIDTH = 256


@dataclass(frozen=True)
class Outlook:
    """What planning says about one scenario; ``D`` volume draws, NumPy arrays.

    Attributes:
        params: scenario parameters.
        layout: the devices.
        lifetimes: ``[D]`` slots by policy: the heuristics, ``rollout``, and ``beam``, which knows the volumes.
        bound: ``[D]`` slots that no policy passes.
        first_failure: ``[n]`` how often each device fails first under the rollout planner; the rest is the UAV's share.
        causes: how often an episode of the rollout planner ends by each :class:`Cause`.
        routes: the tours of ``rollout`` and ``beam`` on the first draw, slot by slot.
        what_if: every repair and removal of one device, the most useful first.
    """

    params: Params
    layout: Layout
    lifetimes: Mapping[str, np.ndarray]
    bound: np.ndarray
    first_failure: np.ndarray
    causes: Mapping[Cause, float]
    routes: Mapping[str, Trace]
    what_if: tuple[WhatIf, ...]


def look_ahead(
    params: Params,
    layout: Layout,
    draws: Key[Array, " D"],
    *,
    width: int = WIDTH,
    samples: int = SAMPLES,
) -> Outlook:
    """Plan for one scenario.

    Args:
        params: scenario parameters.
        layout: the devices.
        draws: volume draws; lifetimes are judged on all of them, the routes are those of the first.
        width: of the beam.
        samples: futures that the rollout planner imagines per candidate.
    """
    count = draws.shape[0]
    # The rollout planner plays the scenario as it is and with every change in one call.
    changed = every_change(layout)
    scenarios = jax.tree.map(lambda *leaves: jnp.repeat(jnp.stack(leaves), count, axis=0), layout, *changed)
    every, many = _repeat(params, len(scenarios.capacity)), _repeat(params, count)
    layouts = jax.tree.map(lambda leaf: leaf[:count], scenarios)
    slots = horizon(every, scenarios)
    tours, ends = play_rollout(every, scenarios, jnp.tile(draws, len(changed) + 1), slots=slots, samples=samples)
    rollout = jax.tree.map(lambda leaf: np.asarray(leaf[:count]), ends)
    best_tours, beam = play_beam(many, layouts, draws, slots=slots, width=width)
    simple = play_heuristics(tuple(HEURISTICS), *_repeat((params, layout), 1), draws[None])
    lifetimes = {name: np.asarray(simple.length[k, 0]) for k, name in enumerate(HEURISTICS)}
    lifetimes |= {"rollout": rollout.length, "beam": np.asarray(beam.length)}
    lives = np.asarray(ends.length).reshape(-1, count)
    return Outlook(
        params=params,
        layout=jax.tree.map(np.asarray, layout),
        lifetimes=lifetimes,
        bound=bound_all(many, layouts, draws, np.max(list(lifetimes.values()), axis=0), slots=slots),
        first_failure=rollout.first_failure.mean(axis=0),
        causes={cause: float(np.mean(rollout.cause == cause)) for cause in Cause if np.any(rollout.cause == cause)},
        routes={
            name: _route(_trace(params, layout, draws[0], tour))
            for name, tour in (("rollout", tours[0]), ("beam", best_tours[0]))
        },
        what_if=rank_changes(layout, lives[1:], lives[0]),
    )


def _repeat(tree: Any, count: int) -> Any:
    return jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf)[None], count, axis=0), tree)


@jax.jit
def _trace(params: Params, layout: Layout, draw: Key[Array, ""], tour: Int[Array, " H"]) -> Trace:
    return trace(tour_policy(tour), params, layout, draw, tour.shape[0])


def _route(played: Trace) -> Trace:
    """The slots that were played, the one the UAV could not pay for left out; NumPy leaves."""
    started = np.asarray(played.played) & ~(np.asarray(played.outcome.cause) == Cause.UAV)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[started], played)

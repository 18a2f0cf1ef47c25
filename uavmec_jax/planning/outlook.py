"""The outlook of one scenario: who lives how long, by which tour, what fails first, and what a repair would bring."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key

from uavmec_jax.planning.beam import horizon
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.lookahead import SAMPLES
from uavmec_jax.planning.parallel import bound_all, play_beam, play_heuristics, play_rollout
from uavmec_jax.world.layout import Layout
from uavmec_jax.world.params import Params
from uavmec_jax.world.physics import Cause
from uavmec_jax.world.rollout import Trace, tour_policy, trace

WIDTH = 256
CHANGES = ("repair power", "repair comms", "remove")


@dataclass(frozen=True)
class WhatIf:
    """What changing one device would bring.

    Attributes:
        device: index from 0.
        change: one of :data:`CHANGES`.
        lifetime: slots, mean over the draws, under the rollout planner.
        gain: slots more than without the change, on the same draws.
    """

    device: int
    change: str
    lifetime: float
    gain: float


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
    count, n = draws.shape[0], layout.capacity.shape[0]
    # The rollout planner plays the scenario as it is and with every change in one call.
    changed = [_changed(layout, device, change) for change in CHANGES for device in range(n)]
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
        what_if=_what_if(layout, lives[1:].reshape(len(CHANGES), n, count), lives[0]),
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


def _what_if(layout: Layout, lives: np.ndarray, now: np.ndarray) -> tuple[WhatIf, ...]:
    """The changes that make sense, ranked; ``lives [3, n, D]`` with them, ``now [D]`` without."""
    lacks = {"repair power": ~np.asarray(layout.has_power), "repair comms": ~np.asarray(layout.has_comms)}
    found = [
        WhatIf(device, change, float(lives[row, device].mean()), float((lives[row, device] - now).mean()))
        for row, change in enumerate(CHANGES)
        for device in range(lives.shape[1])
        if change == "remove" or lacks[change][device]
    ]
    return tuple(sorted(found, key=lambda one: (-one.gain, CHANGES.index(one.change), one.device)))


def _changed(layout: Layout, device: int, change: str) -> Layout:
    """The layout after one change.

    A device that is removed lacks nothing any more, has no work, and its hover point moves to that of another device.
    """
    if change == "repair power":
        return replace(layout, has_power=layout.has_power.at[device].set(True))
    if change == "repair comms":
        return replace(layout, has_comms=layout.has_comms.at[device].set(True))
    neighbour = 1 if device == 0 else 0
    other = neighbour if layout.capacity.shape[0] > 1 else device
    return replace(
        layout,
        position=layout.position.at[device].set(layout.position[other]),
        has_power=layout.has_power.at[device].set(True),
        has_comms=layout.has_comms.at[device].set(True),
        processing_rate=layout.processing_rate.at[device].set(jnp.inf),
    )

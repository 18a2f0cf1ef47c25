"""What-if changes of one device: repair its power, repair its communication, or remove it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode

_T = TypeVar("_T", Layout, State)

CHANGES = ("repair power", "repair comms", "remove")
"""Names of the changes, in the order of :func:`every_change`."""


@dataclass(frozen=True)
class WhatIf:
    """The effect of changing one device, mean over the draws.

    Attributes:
        device: index from 0.
        change: one of :data:`CHANGES`.
        lifetime: slots with the change.
        gain: slots gained by the change; with ``end = "horizon"``, what it adds to ``service``.
        at_least: whether a lifetime with the change reached ``max_slots``: it and the gain may be larger.
        service: with ``end = "horizon"``, the share of the time to the horizon in which the devices are in service with the
            change, else ``None``. A device that is removed does not count, nor does it in what its removal gains.
    """

    device: int
    change: str
    lifetime: float
    gain: float
    at_least: bool = False
    service: float | None = None


def every_change(layout: Layout) -> list[Layout]:
    """Return the layouts after each change of each device, change by change."""
    return [changed(layout, device, change) for change in CHANGES for device in range(layout.capacity.shape[0])]


def changed(layout: Layout, device: int, change: str) -> Layout:
    """Return the layout after one change.

    A removed device stays in the arrays: it lacks nothing, has no work, and its hover point becomes that of a neighbour. It
    is marked as absent if the layout says which devices are present.
    """
    layout = jax.tree.map(jnp.asarray, layout)  # the caller's arrays may be NumPy's
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
        present=None if layout.present is None else layout.present.at[device].set(False),
    )


def layouts_to_try(params: Params, layout: Layout) -> Layout:
    """Return the layout as it is and after each of :func:`every_change`, leaves ``[L, ...]``.

    With ``end = "horizon"``, those follow in which one device is there but weighs nothing: removals are compared with them.
    """
    if params.end != "horizon":
        return _stack([layout, *every_change(layout)])
    weight = layout.service_weight()
    marked = replace(layout, present=_marked(layout), priority=weight)
    ignored = [replace(marked, priority=weight.at[device].set(0.0)) for device in range(layout.n_devices)]
    return _stack([marked, *every_change(marked), *ignored])


def states_to_try(params: Params, layout: Layout, state: State) -> State:
    """Return the state from which each of :func:`layouts_to_try` goes on, leaves ``[L, ...]``.

    They are all ``state``, except that whoever repairs the power of a dead device replaces its battery.
    """
    devices = jnp.arange(layout.n_devices)

    def repaired(device: Array) -> State:
        revived = (devices == device) & (state.failed_at >= 0)
        battery = jnp.where(revived, layout.capacity, state.battery)
        return replace(state, battery=battery, failed_at=jnp.where(revived, -1, state.failed_at))

    others = len(CHANGES) - 1 if params.end == "first_failure" else len(CHANGES)  # with the devices that weigh nothing
    return _stack([state, *map(repaired, devices), *[state] * (others * layout.n_devices)])


def _marked(layout: Layout) -> jax.Array:
    return jnp.ones(layout.n_devices, bool) if layout.present is None else layout.present


def _stack(trees: list[_T]) -> _T:
    stacked: _T = jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
    return stacked


def rank_changes(params: Params, layout: Layout, episodes: Episode, seconds: float) -> tuple[WhatIf, ...]:
    """Return the effects of the changes that repair what a device lacks or remove it, the largest gain first.

    Args:
        params: scenario parameters.
        layout: without any change.
        episodes: of each of :func:`layouts_to_try` on the same draws, leaves ``[L, D, ...]``.
        seconds: time to the horizon, if there is one.
    """
    n, goes_on = layout.n_devices, params.end == "horizon"
    changes = slice(1, 1 + len(CHANGES) * n)
    lifetimes = np.asarray(episodes.length)
    values = np.asarray(episodes.service_s, float) / seconds if goes_on else lifetimes
    unchanged = np.broadcast_to(values[0], values[changes].shape)
    if goes_on:
        unchanged = np.concatenate([unchanged[:-n], values[changes.stop :]])
    gains = _by_change(values[changes] - unchanged, n)
    lived, served = _by_change(lifetimes[changes], n), _by_change(values[changes], n)
    effects = [
        WhatIf(
            device,
            change,
            lifetime=float(lived[number, device].mean()),
            gain=float(gains[number, device].mean()),
            at_least=bool(lived[number, device].max() >= params.max_slots) and not goes_on,
            service=float(served[number, device].mean()) if goes_on else None,
        )
        for number, change in enumerate(CHANGES)
        for device in np.flatnonzero(_APPLIES[change](layout)).tolist()
    ]
    return tuple(sorted(effects, key=lambda effect: (-effect.gain, CHANGES.index(effect.change), effect.device)))


def _by_change(values: Num[np.ndarray, "changes D"], n: int) -> Float[np.ndarray, "3 n D"]:
    return np.asarray(values, float).reshape(len(CHANGES), n, -1)


_APPLIES: dict[str, Callable[[Layout], np.ndarray]] = {
    "repair power": lambda layout: ~np.asarray(layout.has_power),
    "repair comms": lambda layout: ~np.asarray(layout.has_comms),
    "remove": lambda layout: np.ones(layout.n_devices, bool),
}
"""Change -> the devices for which it makes sense."""

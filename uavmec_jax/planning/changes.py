"""What-if changes of one device: repair its power, repair its communication, or remove it."""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from uavmec_jax.env.layout import Layout

CHANGES = ("repair power", "repair comms", "remove")
"""Names of the changes, in the order of :func:`every_change`."""


@dataclass(frozen=True)
class WhatIf:
    """The effect of changing one device.

    Attributes:
        device: index from 0.
        change: one of :data:`CHANGES`.
        lifetime: slots with the change, mean over the draws.
        gain: slots gained by the change, mean over the same draws.
    """

    device: int
    change: str
    lifetime: float
    gain: float


def every_change(layout: Layout) -> list[Layout]:
    """Return the layouts after each change of each device, change by change."""
    return [changed(layout, device, change) for change in CHANGES for device in range(layout.capacity.shape[0])]


def changed(layout: Layout, device: int, change: str) -> Layout:
    """Return the layout after one change.

    A removed device stays in the arrays: it lacks nothing, has no work, and its hover point becomes that of a neighbour.
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


def rank_changes(
    layout: Layout, lifetimes: Int[np.ndarray, "changes D"], unchanged: Int[np.ndarray, " D"]
) -> tuple[WhatIf, ...]:
    """Return the effects of the changes that repair what a device lacks or remove it, the largest gain first.

    Args:
        layout: without any change.
        lifetimes: ``[3 * n, D]`` slots on each draw after each of :func:`every_change`.
        unchanged: ``[D]`` slots on the same draws without any change.
    """
    by_device = lifetimes.reshape(len(CHANGES), -1, len(unchanged))
    applies = {
        "repair power": ~np.asarray(layout.has_power),
        "repair comms": ~np.asarray(layout.has_comms),
        "remove": np.ones(by_device.shape[1], bool),
    }
    effects = [
        WhatIf(device, change, float(after[device].mean()), float((after[device] - unchanged).mean()))
        for change, after in zip(CHANGES, by_device, strict=True)
        for device in np.flatnonzero(applies[change]).tolist()
    ]
    return tuple(sorted(effects, key=lambda effect: (-effect.gain, CHANGES.index(effect.change), effect.device)))

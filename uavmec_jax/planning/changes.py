"""What a crew could do about one device: repair its power, repair its communication, or take it away."""

from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from uavmec_jax.env.layout import Layout

CHANGES = ("repair power", "repair comms", "remove")


@dataclass(frozen=True)
class WhatIf:
    """What changing one device would bring.

    Attributes:
        device: index from 0.
        change: one of :data:`CHANGES`.
        lifetime: slots, mean over the draws.
        gain: slots more than without the change, on the same draws.
    """

    device: int
    change: str
    lifetime: float
    gain: float


def every_change(layout: Layout) -> list[Layout]:
    """The layout after each change of each device, change by change."""
    return [changed(layout, device, change) for change in CHANGES for device in range(layout.capacity.shape[0])]


def changed(layout: Layout, device: int, change: str) -> Layout:
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


def rank_changes(layout: Layout, lives: Any, now: Any) -> tuple[WhatIf, ...]:
    """The changes that make sense, the most useful first.

    Args:
        layout: as it is.
        lives: ``[3 * n, D]`` slots with each of :func:`every_change`.
        now: ``[D]`` slots without, on the same draws.
    """
    lives = np.asarray(lives).reshape(len(CHANGES), -1, len(now))
    lacks = {"repair power": ~np.asarray(layout.has_power), "repair comms": ~np.asarray(layout.has_comms)}
    found = [
        WhatIf(device, change, float(lives[row, device].mean()), float((lives[row, device] - now).mean()))
        for row, change in enumerate(CHANGES)
        for device in range(lives.shape[1])
        if change == "remove" or lacks[change][device]
    ]
    return tuple(sorted(found, key=lambda one: (-one.gain, CHANGES.index(one.change), one.device)))

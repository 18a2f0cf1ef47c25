"""Layouts on a place: positions of a simulated evacuation, and the traffic that its devices see."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from uavmec_jax.env.layout import Layout, Traffic
from uavmec_jax.traffic.evacuation import Evacuation


def on_place(
    layout: Layout, evacuation: Evacuation, *, moving: bool = False, scale_to_m: float | None = None
) -> Layout:
    """Place the devices of a layout where those of an evacuation stand.

    Args:
        layout: hardware, batteries, power and communication of ``n`` devices.
        evacuation: of ``n`` devices.
        moving: their weights follow the evacuation's windows; by default they are its mean, as in the paper.
        scale_to_m: see :meth:`Evacuation.local_position`.
    """
    traffic = Traffic(
        weight=jnp.asarray(traffic_weights(evacuation, moving)),
        window_s=jnp.float32(evacuation.meta["window_s"]),
        price=jnp.float32(0),
    )
    position = jnp.asarray(evacuation.local_position(scale_to_m), jnp.float32)
    return replace(layout, position=position, traffic=traffic)


def traffic_weights(evacuation: Evacuation, moving: bool) -> np.ndarray:
    """Weights ``[W, n]`` of every window of an evacuation, or ``[1, n]``, their mean."""
    return evacuation.window_weight if moving else evacuation.weight[None]

"""Layouts in a place: the devices' positions in a simulated evacuation and the traffic around them."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from uavmec_jax.env.checks import POSITION, check_bool, check_range
from uavmec_jax.env.layout import Layout, Traffic
from uavmec_jax.errors import ArgumentError
from uavmec_jax.traffic.evacuation import Evacuation


def on_place(
    layout: Layout, evacuation: Evacuation, *, moving: bool = False, scale_to_m: float | None = None
) -> Layout:
    """Return a layout whose devices have the positions and the traffic of an evacuation.

    Args:
        layout: hardware, batteries, power and communication of ``n`` devices.
        evacuation: a simulated evacuation with ``n`` devices.
        moving: whether the traffic weights follow the evacuation's windows; by default they are its mean, as in the paper.
        scale_to_m: see :meth:`Evacuation.local_position`.

    Raises:
        ArgumentError: the numbers of devices differ, or the length is not positive; one line.
    """
    if layout.n_devices != evacuation.n_devices:
        raise ArgumentError(
            f"layout has {layout.n_devices} devices; it should have those of {evacuation.name}, {evacuation.n_devices}"
        )
    check_bool("moving", moving)
    if scale_to_m is not None:
        check_range("scale_to_m", scale_to_m, gt=0, le=POSITION.le)
    traffic = Traffic(
        weight=jnp.asarray(traffic_weights(evacuation, moving)),
        window_s=jnp.float32(evacuation.meta["window_s"]),
        price=jnp.float32(0),
    )
    position = jnp.asarray(evacuation.local_position(scale_to_m), jnp.float32)
    return replace(layout, position=position, traffic=traffic)


def traffic_weights(evacuation: Evacuation, moving: bool) -> Float[np.ndarray, "W n"]:
    """Return the traffic weights of every window of an evacuation, or their mean as its only window."""
    return evacuation.window_weight if moving else evacuation.weight[None]

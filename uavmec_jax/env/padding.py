"""Padding: entries of a layout that are no devices, so that layouts of different sizes fit into one batch."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from uavmec_jax.env.checks import check_range
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import MAX_DEVICES
from uavmec_jax.env.scenario_checks import check_layout
from uavmec_jax.errors import ArgumentError

_FAR_AWAY_M = 1e6
"""Coordinates of padding: out of range of all devices, and further than the UAV's battery reaches."""


def mask_absent(layout: Layout, present: Bool[Array, " n"]) -> Layout:
    """Return the layout with the entries that are not ``present`` made inert: they need nothing and are far away.

    The dynamics and the planners then need no special case for padding; only the choice of an action has to mask it.
    """

    def keep(value: Float[Array, " n"], padding: float) -> Float[Array, " n"]:
        return jnp.where(present, value, padding)

    return replace(
        layout,
        position=jnp.where(present[:, None], layout.position, _FAR_AWAY_M),
        capacity=keep(layout.capacity, 1.0),
        has_power=layout.has_power | ~present,
        has_comms=layout.has_comms | ~present,
        standby_power=keep(layout.standby_power, 0.0),
        active_power=keep(layout.active_power, 0.0),
        processing_rate=keep(layout.processing_rate, jnp.inf),
        present=present,
    )


def pad_layout(layout: Layout, size: int) -> Layout:
    """Append padding to a layout, so that layouts with different numbers of devices fit into one batch.

    Args:
        layout: ``n`` devices, without batch axes.
        size: number of entries of the result, at least ``n``.

    Raises:
        ArgumentError: there are more than ``size`` devices, or a value of the layout is out of range; one line.
    """
    if jnp.ndim(layout.capacity) != 1:
        raise ArgumentError(
            f"layout has capacities of shape {jnp.shape(layout.capacity)}; give one layout, not a batch"
        )
    check_layout(layout)
    check_range("size", size, ge=1, le=MAX_DEVICES, whole=True)
    n = layout.capacity.shape[0]
    if n > size:
        raise ArgumentError(f"size is {size}; the layout has {n} devices: give {n} or more")

    def pad(leaf: Array) -> Array:
        return jnp.pad(jnp.asarray(leaf), ((0, size - n),) + ((0, 0),) * (jnp.ndim(leaf) - 1))

    present = jnp.ones(n, bool) if layout.present is None else layout.present
    traffic = layout.traffic
    if traffic is not None:
        traffic = replace(traffic, weight=jnp.pad(jnp.asarray(traffic.weight), ((0, 0), (0, size - n))))
    padded = jax.tree.map(pad, replace(layout, traffic=None, present=None, fleet=None, depots=None))
    return mask_absent(replace(padded, traffic=traffic, fleet=layout.fleet, depots=layout.depots), pad(present))

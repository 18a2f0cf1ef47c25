"""Layouts: what one random draw, or one user's named_scenario, fixes about the devices."""

import math
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from uavmec_jax.env import hardware as tables
from uavmec_jax.env.params import Params
from uavmec_jax.env.types import Scalar


@struct.dataclass
class Traffic:
    """How much traffic each device sees while its town is evacuated.

    Attributes:
        weight: ``[W, n]`` in [0, 1], one row for each window of the evacuation; one row alone stands for all of it.
        window_s: s, length of a window; the first one begins with the first slot, the last one lasts.
        price: slots of life that a planner would give for a device in the densest traffic not to be the first to fail,
            less for others in proportion; what a policy that knows the full observation aims at.
    """

    weight: Float[Array, "*batch W n"]
    window_s: Scalar = math.inf
    price: Scalar = 0.0

    def at(self, seconds: Any) -> Any:
        """Weights ``[n]`` at a time in seconds since the first slot began."""
        windows = self.weight.shape[0]
        if windows == 1:
            return self.weight[0]
        return self.weight[jnp.minimum(seconds / self.window_s, windows - 1).astype(jnp.int32)]


@struct.dataclass
class Layout:
    """The devices of one scenario; every field has one entry per device, batches put their axes in front.

    Attributes:
        position: ``[n, 2]`` m, in the region.
        device_type: ``[n]`` int, index into :data:`tables.DEVICE_TYPES`.
        task: ``[n]`` int, index into :data:`tables.TASKS`.
        capacity: ``[n]`` J, battery capacity.
        has_power: ``[n]`` bool, grid power is there (delta_E = 0).
        has_comms: ``[n]`` bool, communication is there (delta_C = 0).
        standby_power: ``[n]`` W, from the type.
        active_power: ``[n]`` W, from type and task.
        processing_rate: ``[n]`` bytes/s, from type and task.
        traffic: what traffic they see, or ``None``: nobody knows.
        present: ``[n]`` bool, which entries are devices, the others fill up (:func:`pad_layout`); ``None``: all are.
    """

    position: Float[Array, "*batch n 2"]
    device_type: Int[Array, "*batch n"]
    task: Int[Array, "*batch n"]
    capacity: Float[Array, "*batch n"]
    has_power: Bool[Array, "*batch n"]
    has_comms: Bool[Array, "*batch n"]
    standby_power: Float[Array, "*batch n"]
    active_power: Float[Array, "*batch n"]
    processing_rate: Float[Array, "*batch n"]
    traffic: Traffic | None = None
    present: Bool[Array, "*batch n"] | None = None

    def failure_price(self, seconds: Any) -> Any:
        """Slots of life ``[n]`` that the first failure of each device is priced at, at a time as in :meth:`Traffic.at`."""
        if self.traffic is None:
            return jnp.zeros(self.capacity.shape)
        return self.traffic.price * self.traffic.at(seconds)


def make_layout(
    position: Float[Array, "n 2"],
    device_type: Int[Array, " n"],
    task: Int[Array, " n"],
    capacity: Float[Array, " n"],
    has_power: Bool[Array, " n"],
    has_comms: Bool[Array, " n"],
) -> Layout:
    """Look up powers and rates (Tables 1-3) and return the complete :class:`Layout`."""
    return Layout(
        position=position,
        device_type=device_type,
        task=task,
        capacity=capacity,
        has_power=has_power,
        has_comms=has_comms,
        standby_power=jnp.asarray(tables.STANDBY_POWER_W)[device_type],
        active_power=jnp.asarray(tables.ACTIVE_POWER_W)[task, device_type],
        processing_rate=jnp.asarray(tables.PROCESSING_RATE_BYTES_S)[task, device_type],
    )


def sample_layout(key: PRNGKeyArray, params: Params, n_powered: Any, n_connected: Any) -> Layout:
    """Draw a random layout (paper, section 3.1).

    Positions are uniform in the region, type and task uniform over Tables 2-3, capacity uniform in its range. Exactly
    ``n_powered`` devices have grid power and exactly ``n_connected`` have communication; the two sets are uniform and
    independent. With one key, layouts of different counts differ in the masks alone, and the masks are nested: lowering
    a count takes the resource from further devices of the same town.

    Args:
        key: typed PRNG key.
        params: scenario parameters; ``n_devices`` fixes the shapes.
        n_powered: devices with power, int in ``[0, n]``; may be traced.
        n_connected: devices with communication, int in ``[0, n]``; may be traced.
    """
    n = params.n_devices
    k_position, k_type, k_task, k_capacity, k_power, k_comms = jax.random.split(key, 6)
    low, high = params.device_battery_range_j
    region = jnp.stack([jnp.asarray(side, jnp.float32) for side in params.region_m])
    return make_layout(
        position=jax.random.uniform(k_position, (n, 2)) * region,
        device_type=jax.random.randint(k_type, (n,), 0, len(tables.DEVICE_TYPES)),
        task=jax.random.randint(k_task, (n,), 0, len(tables.TASKS)),
        capacity=jax.random.uniform(k_capacity, (n,), minval=low, maxval=high),
        has_power=jax.random.permutation(k_power, n) < n_powered,
        has_comms=jax.random.permutation(k_comms, n) < n_connected,
    )


_NOWHERE_M = 1e6
"""Where entries stand that are no devices: out of everybody's range and beyond the UAV's battery."""


def mask_absent(layout: Layout, present: Bool[Array, " n"]) -> Layout:
    """The layout with the entries that are not ``present`` made harmless: they lack nothing, do nothing and are far away.

    Every function of the package then treats them rightly without knowing of them; who offers actions masks them.
    """
    keep = lambda value, otherwise: jnp.where(present, value, otherwise)  # noqa: E731
    return replace(
        layout,
        position=jnp.where(present[:, None], layout.position, _NOWHERE_M),
        capacity=keep(layout.capacity, 1.0),
        has_power=layout.has_power | ~present,
        has_comms=layout.has_comms | ~present,
        standby_power=keep(layout.standby_power, 0.0),
        active_power=keep(layout.active_power, 0.0),
        processing_rate=keep(layout.processing_rate, jnp.inf),
        present=present,
    )


def pad_layout(layout: Layout, size: int) -> Layout:
    """The layout with entries that are no devices behind it, so that layouts of different counts fit into one batch.

    Args:
        layout: ``n`` devices.
        size: entries wanted, at least ``n``.

    Raises:
        ValueError: there are more devices.
    """
    n = layout.capacity.shape[0]
    if n > size:
        raise ValueError(f"the layout has {n} devices; they do not fit into {size}")
    fill = lambda leaf: jnp.pad(jnp.asarray(leaf), ((0, size - n),) + ((0, 0),) * (jnp.ndim(leaf) - 1))  # noqa: E731
    present = jnp.ones(n, bool) if layout.present is None else layout.present
    traffic = layout.traffic
    if traffic is not None:
        traffic = replace(traffic, weight=jnp.pad(jnp.asarray(traffic.weight), ((0, 0), (0, size - n))))
    bare = jax.tree.map(fill, replace(layout, traffic=None, present=None))
    return mask_absent(replace(bare, traffic=traffic), fill(present))

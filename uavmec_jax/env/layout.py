"""Layouts: the devices of a scenario, random or given."""

import math

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num, PRNGKeyArray

from uavmec_jax.env import hardware
from uavmec_jax.env.checks import CAPACITY, LARGEST, POSITION, Bounds, Check, check_bool, check_ranges
from uavmec_jax.env.fleet import UAV_FIELDS, Depots, Fleet, default_start
from uavmec_jax.env.params import Params, check_params
from uavmec_jax.env.types import Scalar


@struct.dataclass
class Traffic:
    """The traffic around each device during an evacuation.

    Attributes:
        weight: traffic weights in [0, 1], one row per time window; a single row holds for the whole evacuation.
        window_s: length of a window, s; the first one begins with the first slot, the last one does not end.
        price: slots of lifetime worth giving up so that a device in the densest traffic is not the first to fail,
            proportionally less for a device in lighter traffic. Planners, and policies with the full observation, use it.
    """

    weight: Float[Array, "*batch W n"]
    window_s: Scalar = math.inf
    price: Scalar = 0.0

    def at(self, seconds: Num[ArrayLike, ""]) -> Float[Array, " n"]:
        """Return the weights at a time, in seconds since the first slot began."""
        windows = self.weight.shape[0]
        if windows == 1:
            return self.weight[0]
        return self.weight[jnp.minimum(seconds / self.window_s, windows - 1).astype(jnp.int32)]


@struct.dataclass
class Layout:
    """The devices of one scenario, and what serves them; every array has one entry per device.

    Attributes:
        position: coordinates in the region, m.
        device_type: index into :data:`hardware.DEVICE_TYPES`.
        task: index into :data:`hardware.TASKS`.
        capacity: battery capacity, J.
        has_power: whether the device has grid power (delta_E = 0).
        has_comms: whether the device has communication (delta_C = 0).
        standby_power: given by the type, W.
        active_power: given by type and task, W.
        processing_rate: given by type and task, bytes/s.
        traffic: the traffic around the devices, ``None`` if it is unknown.
        present: which entries are devices and not padding (:func:`pad_layout`); ``None`` if all are.
        priority: weight of each device in measures of service, e.g. of a hospital's; ``None``: all weigh 1.
        fleet: the UAVs, ``None`` for the one of the parameters.
        depots: where UAVs swap or charge their batteries, ``None`` for none.
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
    priority: Float[Array, "*batch n"] | None = None
    fleet: Fleet | None = None
    depots: Depots | None = None

    @property
    def n_devices(self) -> int:
        """Number of devices ``n``, padding included."""
        return self.capacity.shape[-1]

    @property
    def n_uavs(self) -> int:
        """Number of UAVs ``K``, padding included."""
        return 1 if self.fleet is None else self.fleet.speed_m_s.shape[-1]

    @property
    def n_depots(self) -> int:
        """Number of depots ``D``, padding included."""
        return 0 if self.depots is None else self.depots.kind.shape[-1]

    @property
    def n_places(self) -> int:
        """Number of places that a UAV can fly to, ``n + D``: the devices, then the depots."""
        return self.n_devices + self.n_depots

    @property
    def action_shape(self) -> tuple[int, ...]:
        """Shape of an action: ``()`` for one UAV, ``(K,)`` for a fleet."""
        return () if self.n_uavs == 1 else (self.n_uavs,)

    def places(self) -> Float[Array, "n_places 2"]:
        """Return the positions of all places in m, without batch axes."""
        if self.depots is None:
            return jnp.asarray(self.position)
        return jnp.concatenate([self.position, self.depots.position])

    def service_weight(self) -> Float[Array, "*batch n"]:
        """Return the weight of each device in measures of service: its priority, 1 by default; padding weighs nothing."""
        weight = jnp.ones(self.capacity.shape) if self.priority is None else self.priority
        return weight if self.present is None else jnp.where(self.present, weight, 0.0)

    def failure_price(self, seconds: Num[ArrayLike, ""]) -> Float[Array, " n"]:
        """Return the price of each device's first failure, in slots of lifetime, at a time as in :meth:`Traffic.at`."""
        if self.traffic is None:
            return jnp.zeros(self.capacity.shape)
        return self.traffic.price * self.traffic.at(seconds)


def check_one_uav(layout: Layout, what: str) -> None:
    """Check that there is one UAV without depots, for the sake of ``what``, which knows nothing else.

    Raises:
        ValueError: there are several, or depots; one line.
    """
    if layout.action_shape or layout.n_depots:
        uavs, depots = layout.n_uavs, layout.n_depots
        has = f"{uavs} UAV{'s' * (uavs != 1)} and {depots} depot{'s' * (depots != 1)}"
        raise ValueError(f"the layout has {has}; {what} is for one UAV without depots")


def fleet_of(params: Params, layout: Layout) -> Fleet:
    """Return the UAVs of a layout without batch axes; the one of the parameters is a fleet of one."""
    if layout.fleet is not None:
        return layout.fleet
    fields = {name: jnp.asarray(getattr(params, f"uav_{name}"), jnp.float32)[None] for name in UAV_FIELDS}
    return Fleet(**fields, start_m=default_start(1, layout.depots))


DEVICE_BOUNDS = {
    "device_type": Bounds(ge=hardware.UNLISTED, le=len(hardware.DEVICE_TYPES) - 1, whole=True),
    "task": Bounds(ge=hardware.UNLISTED, le=len(hardware.TASKS) - 1, whole=True),
    "capacity": CAPACITY,
    "standby_power": Bounds(ge=0, le=LARGEST),
    "active_power": Bounds(ge=0, le=LARGEST),
    "processing_rate": Bounds(gt=0, infinite=True),
}
"""Ranges of the numbers of each device in a :class:`Layout`, padding included."""


def make_layout(
    position: Float[Array, "n 2"],
    device_type: Int[Array, " n"],
    task: Int[Array, " n"],
    capacity: Float[Array, " n"],
    has_power: Bool[Array, " n"],
    has_comms: Bool[Array, " n"],
) -> Layout:
    """Return a :class:`Layout` of the given devices, with powers and rates looked up by type and task (Tables 1-3).

    Raises:
        ArgumentError: a number is out of range; the line names it and the device. Traced types and tasks are clamped.
    """
    chex.assert_shape([device_type, task, capacity, has_power, has_comms], (position.shape[0],))
    chex.assert_shape(position, (None, 2))
    listed = {"device_type": (device_type, hardware.DEVICE_TYPES), "task": (task, hardware.TASKS)}
    checks = [
        Check(name, value, Bounds(ge=0, le=len(table) - 1, whole=True), ("device",))
        for name, (value, table) in listed.items()
    ]
    checks += [
        Check("position", position, POSITION, ("device", "")),
        Check("capacity", capacity, CAPACITY, ("device",)),
    ]
    check_ranges(checks)
    check_bool("has_power", has_power)
    check_bool("has_comms", has_comms)
    return Layout(
        position=position,
        device_type=device_type,
        task=task,
        capacity=capacity,
        has_power=has_power,
        has_comms=has_comms,
        standby_power=jnp.asarray(hardware.STANDBY_POWER_W)[device_type],
        active_power=jnp.asarray(hardware.ACTIVE_POWER_W)[task, device_type],
        processing_rate=jnp.asarray(hardware.PROCESSING_RATE_BYTES_S)[task, device_type],
    )


def sample_layout(
    key: PRNGKeyArray, params: Params, n_powered: Num[ArrayLike, ""], n_connected: Num[ArrayLike, ""]
) -> Layout:
    """Draw a random layout (paper, section 3.1).

    Positions are uniform in the region, type and task uniform over Tables 2-3, capacity uniform in its range. Exactly
    ``n_powered`` devices have grid power and exactly ``n_connected`` have communication; the two sets are uniform and
    independent. Layouts drawn with the same key but other counts differ only in these two masks, and the masks are
    nested: lowering a count takes the resource from some of the devices that had it.

    Args:
        key: typed PRNG key.
        params: simulation parameters; ``n_devices`` fixes the shapes.
        n_powered: number of devices with power, in ``[0, n]``; may be traced, and then counts as 0 below and as n above.
        n_connected: number of devices with communication, likewise.

    Raises:
        ArgumentError: a count or a parameter is out of range; one line.
    """
    chex.assert_rank([n_powered, n_connected], 0)
    n = params.n_devices
    check_params(params)
    counts = Bounds(ge=0, le=n, whole=True)
    check_ranges([Check("n_powered", n_powered, counts), Check("n_connected", n_connected, counts)])
    k_position, k_type, k_task, k_capacity, k_power, k_comms = jax.random.split(key, 6)
    low, high = params.device_battery_range_j
    region = jnp.stack([jnp.asarray(side, jnp.float32) for side in params.region_m])
    return make_layout(
        position=jax.random.uniform(k_position, (n, 2)) * region,
        device_type=jax.random.randint(k_type, (n,), 0, len(hardware.DEVICE_TYPES)),
        task=jax.random.randint(k_task, (n,), 0, len(hardware.TASKS)),
        capacity=jax.random.uniform(k_capacity, (n,), minval=low, maxval=high),
        has_power=jax.random.permutation(k_power, n) < n_powered,
        has_comms=jax.random.permutation(k_comms, n) < n_connected,
    )

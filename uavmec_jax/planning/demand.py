"""The demand of a scenario: which devices a hover point covers, what a slot costs, how many visits every device needs.

The planners and the upper bound are built on these quantities. Each is a relaxation of the slot's physics in favour of
the network: a true slot is never shorter, a true visit never saves more energy, and a device never needs fewer visits than
computed here.

Two words are used throughout. A device is *needy* if it lacks power or communication: only needy devices need visits. The
*hover point* of a device is the point above it; the UAV hovers above one device in every slot.
"""

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from uavmec_jax.env.channel import upload_rate
from uavmec_jax.env.dynamics import slots_to_expiry
from uavmec_jax.env.fleet import Fleet
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.slot import result_times

_ROUNDING = 1e-5
"""Relative tolerance for single precision, always applied in favour of the network."""

NEVER = 1_000_000
"""Deadline, in slots, of something that never falls due."""


@struct.dataclass
class SlotCosts:
    """Costs of ``H`` slots with given task volumes, flight excluded; without the leading axis those of one slot.

    Attributes:
        duration: ``[H, n]`` s, length of the slot with the UAV above each device.
        work: ``[H, n]`` J, energy that an unserved device spends on computing and on sending its results.
        upload: ``[H, n]`` J, least energy that a served device spends on its upload, the UAV being right above it.
    """

    duration: Float[Array, "*batch n"]
    work: Float[Array, "*batch n"]
    upload: Float[Array, "*batch n"]


def coverage(params: Params, layout: Layout) -> Bool[Array, "n n"]:
    """Return ``covers[a, d]``: whether a UAV hovering above device ``a`` serves device ``d``.

    Of a fleet it is the UAV with the largest signal range.
    """
    signal_range = params.uav_signal_range_m
    if (fleet := layout.fleet) is not None:
        present = True if fleet.present is None else fleet.present
        signal_range = jnp.max(jnp.where(present, fleet.signal_range_m, 0.0))
    return (_slant(params, layout) <= signal_range) | jnp.eye(layout.capacity.shape[0], dtype=bool)


def upload_rates(params: Params, layout: Layout) -> Float[Array, "n n"]:
    """Return the rates in bit/s from the hover point of each device to each device."""
    return jax.vmap(lambda slant: upload_rate(params, slant))(_slant(params, layout))


def work_times(
    params: Params, layout: Layout, volumes: Num[Array, "H n"]
) -> tuple[Float[Array, "H n"], Float[Array, " n"]]:
    """Return the seconds that each device computes if it is not served, and those in which it then sends its results."""
    t_compute = jnp.minimum(volumes / layout.processing_rate, params.slot_cap_s)
    return t_compute, result_times(params, layout)


def _slant(params: Params, layout: Layout) -> Float[Array, "n n"]:
    """Return the slant distances in m from the hover point of each device to each device."""
    ground = layout.position[:, None] - layout.position[None]
    return jnp.sqrt(jnp.sum(ground**2, axis=-1) + params.uav_altitude_m**2)


def visit_shares(layout: Layout, covers: Bool[Array, "n n"]) -> Float[Array, " n"]:
    """Return the share of a visit that each device accounts for, such that no slot is worth more than one visit.

    The share of a needy device is the reciprocal of the largest number of needy devices that a hover point covering it
    covers: 1 if no hover point covers it together with another needy device. Other devices have share 0.

    Wherever the UAV hovers, the shares of the devices served sum to at most 1. The shares are thus a feasible solution of
    the dual of the covering problem "choose hover points so that every device is covered as often as it needs", and by
    weak duality ``sum(visit_shares * visits_needed)`` is a lower bound on the number of slots.
    """
    return shares_of(~layout.has_power | ~layout.has_comms, covers)


def shares_of(subset: Bool[Array, " n"], covers: Bool[Array, "n n"]) -> Float[Array, " n"]:
    """Return shares like those of :func:`visit_shares`, of the devices of any subset: no hover point covers more than 1."""
    n_covered = jnp.sum(covers & subset, axis=1)
    largest = jnp.max(jnp.where(covers, n_covered[:, None], 1), axis=0)
    return jnp.where(subset, 1.0 / largest, 0.0)


def best_hover_point(covers: Bool[Array, "n n"], subset: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Return, for each device, the hover point that covers it and the most devices of ``subset``."""
    n_covered = jnp.sum(covers & subset, axis=1)
    return jnp.argmax(jnp.where(covers, n_covered[:, None], -1), axis=0)


def slot_costs(params: Params, layout: Layout, volumes: Num[Array, "H n"]) -> SlotCosts:
    """Return the costs of every slot of a volume draw; ``volumes`` in bytes."""
    chex.assert_shape(volumes, (None, layout.capacity.shape[0]))
    covers = coverage(params, layout)
    rate = upload_rates(params, layout)
    t_compute, t_results = work_times(params, layout, volumes)

    def durations(volumes: Num[Array, " n"], t_unserved: Float[Array, " n"]) -> Float[Array, " n"]:
        return jnp.max(jnp.where(covers, 8.0 * volumes / rate, t_unserved), axis=1)

    return SlotCosts(
        duration=jax.vmap(durations)(volumes, t_compute + t_results),
        work=layout.active_power * t_compute + params.transmit_power_w * t_results,
        upload=params.transmit_power_w * 8.0 * volumes / jnp.diagonal(rate),
    )


def mean_slot(params: Params, layout: Layout) -> SlotCosts:
    """Return the expected slot, before its volumes are known; leaves ``[n]``.

    The mean work, ``E[min(v / rate, cap)]`` over uniform volumes ``v``, is exact; the duration is that of mean work.
    """
    return jax.tree.map(lambda leaf: leaf[0], slot_costs(params, layout, mean_volumes(params, layout)[None]))


def mean_volumes(params: Params, layout: Layout) -> Float[Array, " n"]:
    """Return the volumes in bytes that each device gets done in a slot on average if it is not served."""
    low, high = (jnp.asarray(bound, jnp.float32) for bound in params.task_volume_range_bytes)
    fits = jnp.clip(params.slot_cap_s * layout.processing_rate, low, high)
    done = 0.5 * (fits**2 - low**2) + (high - fits) * fits
    return jnp.where(high > low, done / jnp.maximum(high - low, 1.0), low)


def idle_drain(layout: Layout, costs: SlotCosts) -> Float[Array, "*H n"]:
    """Return the energy in J that each battery loses in a slot if its device is not served and the slot is shortest."""
    return layout.standby_power * jnp.min(costs.duration, axis=-1, keepdims=True) + costs.work


@struct.dataclass
class BatteryDemand:
    """What surviving the slots ``first .. last - 1`` demands of the batteries.

    Attributes:
        drain: ``[n]`` J, energy that each device uses if it is never served; 0 with grid power.
        saved: ``[H + 1, n]`` J, the most energy that 0, 1, ... H services can save.
        slots: int, number of slots, ``last - first``.
    """

    drain: Float[Array, "*batch n"]
    saved: Float[Array, "*batch services n"]
    slots: Int[Array, "*batch"]


def battery_demand(
    layout: Layout, costs: SlotCosts, first: int | Int[Array, ""], last: int | Int[Array, ""]
) -> BatteryDemand:
    """Return the demand of the slots ``first .. last - 1``, in which the services with the largest savings come first."""
    slot = jnp.arange(costs.work.shape[0])[:, None]
    counts = (slot >= first) & (slot < last) & ~layout.has_power
    saving = jnp.sort(jnp.where(counts, jnp.maximum(costs.work - costs.upload, 0.0), 0.0), axis=0, descending=True)
    return BatteryDemand(
        drain=jnp.sum(jnp.where(counts, idle_drain(layout, costs), 0.0), axis=0),
        saved=jnp.concatenate([jnp.zeros_like(saving[:1]), jnp.cumsum(saving, axis=0)]),
        slots=jnp.maximum(last - first, 0),
    )


def battery_visits(
    layout: Layout, demand: BatteryDemand, battery: Float[Array, "*B n"]
) -> tuple[Float[Array, "*B n"], Float[Array, "*B n"], Bool[Array, "*B n"]]:
    """Count the services that keep each battery above zero.

    Args:
        layout: the devices.
        demand: of the slots to survive.
        battery: J left; any batch axes in front.

    Returns:
        The least number of services; the same before rounding up, for comparing states; and whether even a service in
        every slot is not enough.
    """
    missing = jnp.where(layout.has_power, -1.0, demand.drain * (1.0 - _ROUNDING) - battery)
    per_joule = 1.0 / jnp.maximum(jnp.diff(demand.saved, axis=0), 1e-3)

    def count(visits: Int[Array, ""], counted: tuple[Array, Array]) -> tuple[Array, Array]:
        whole, fractional = counted
        beyond = missing - demand.saved[visits]
        return whole + (beyond >= 0.0), fractional + jnp.clip(beyond * per_joule[visits], 0.0, 1.0)

    # A loop over the remaining slots: far fewer than the rows of the table, which spans the longest lifetime.
    start = (jnp.zeros_like(missing), jnp.zeros_like(missing))
    whole, fractional = jax.lax.fori_loop(0, demand.slots, count, start)
    return whole, fractional, missing >= demand.saved[-1]


def age_visits(
    params: Params, layout: Layout, age: Int[Array, "*B n"], slots: Num[ArrayLike, ""]
) -> tuple[Float[Array, "*B n"], Float[Array, "*B n"]]:
    """Return the services that keep the data of each device fresh for ``slots`` more slots: rounded down, and exact."""
    exact = jnp.where(layout.has_comms, 0.0, (age + slots) / jnp.maximum(slots_to_expiry(params), 1))
    return jnp.floor(exact), exact


def misses_deadline(
    params: Params,
    layout: Layout,
    visit_share: Float[Array, " n"],
    age: Int[Array, "*B n"],
    slots: Num[ArrayLike, ""],
    servers: int | Int[Array, "*B 1"] = 1,
) -> Bool[Array, "*B"]:
    """Return whether the data that expire within ``slots`` more slots can no longer all be refreshed in time.

    This is the demand test of earliest-deadline scheduling: for every deadline, the visits due by then, counted in
    :func:`visit_shares`, must fit into the slots until then, in each of which ``servers`` UAVs make one visit.
    """
    deadline = slots_to_expiry(params) - age
    counts = ~layout.has_comms & (deadline <= slots)
    load = load_by_deadline(jnp.where(counts, deadline, jnp.iinfo(jnp.int32).max), visit_share)
    return jnp.any(counts & (load > servers * deadline + _ROUNDING * 10), axis=-1)


def load_by_deadline(deadline: Num[Array, "*B n"], visit_share: Float[Array, " n"]) -> Float[Array, "*B n"]:
    """Return the sum of the visit shares that are due no later than each entry's own deadline."""
    # One entry against all others at a time, entries in rows: the batch stays the innermost axis, as a CPU likes it.
    rows = jnp.moveaxis(deadline, -1, 0)
    add = lambda entry, load: load + jnp.where(rows[entry] <= rows, visit_share[entry], 0.0)  # noqa: E731
    return jnp.moveaxis(jax.lax.fori_loop(0, rows.shape[0], add, jnp.zeros(rows.shape)), 0, -1)


def max_by_hover_point(hover_point: Int[Array, " n"], value: Num[Array, "*B n"]) -> Num[Array, "*B n"]:
    """Return the largest value among the devices assigned to each hover point; ``-NEVER`` where there are none."""
    rows = jnp.moveaxis(value, -1, 0)
    lowest = jnp.full(rows.shape, -NEVER, rows.dtype)
    update = lambda device, largest: largest.at[hover_point[device]].max(rows[device])  # noqa: E731
    return jnp.moveaxis(jax.lax.fori_loop(0, rows.shape[0], update, lowest), 0, -1)


def flight_power(params: Params, fleet: Fleet | None = None) -> tuple[Float[Array, "*K"], Float[Array, "*K"]]:
    """Return ``(base, extra)`` in W: a slot costs a UAV that hovers at least ``base * duration + extra * flight_time``.

    Args:
        params: scenario parameters.
        fleet: the UAVs; ``None`` for the one of the parameters, whose powers are scalars.
    """
    flying, hovering = params.uav_flying_power_w, params.uav_hovering_power_w
    if fleet is not None:
        flying, hovering = fleet.flying_power_w, fleet.hovering_power_w
    extra = flying - jnp.where(params.flight_power_adds_to_hover, 0.0, hovering)
    return hovering + jnp.minimum(extra, 0.0), jnp.maximum(extra, 0.0)

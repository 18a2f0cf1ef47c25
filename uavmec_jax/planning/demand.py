"""What a scenario demands of the UAV: who is served where, what a slot costs, how many visits every device needs.

The planners and the bound reason with these quantities. Each is on the safe side of the slot's physics: the true slot
is never shorter, a visit never saves more, and a device never needs fewer visits than is said here.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Num

from uavmec_jax.env.dynamics import slots_to_expiry, upload_rate
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params

_ROUNDING = 1e-5
"""Relative allowance for single precision, always given in favour of the network."""

NEVER = 1_000_000
"""Slots until something falls due that never does."""


@struct.dataclass
class SlotCosts:
    """What ``H`` slots cost with given volumes, flight left out.

    Attributes:
        duration: ``[H, n]`` s, length of the slot with the UAV above each device.
        work: ``[H, n]`` J, computing (and sending the results) of a device that is not served.
        upload: ``[H, n]`` J, the least that a served device spends, with the UAV right above it.
    """

    duration: Any
    work: Any
    upload: Any


def coverage(params: Params, layout: Layout) -> Bool[Array, "n n"]:
    """``covers[a, d]``: a UAV hovering above device ``a`` serves device ``d``."""
    return (_slant(params, layout) <= params.uav_signal_range_m) | jnp.eye(layout.capacity.shape[0], dtype=bool)


def _slant(params: Params, layout: Layout) -> Float[Array, "n n"]:
    ground = layout.position[:, None] - layout.position[None]
    return jnp.sqrt(jnp.sum(ground**2, axis=-1) + params.uav_altitude_m**2)


def visit_shares(layout: Layout, covers: Bool[Array, "n n"]) -> Float[Array, " n"]:
    """Share of a visit that each device is visit_share with; no hover point's devices are visit_share more than one visit.

    1 for a needy device that nobody visit_shares a hover point with, 0 for one that has power and communication. Whatever the
    UAV does, the visit_share visit_shares of the devices served in one slot sum to at most 1, so ``sum(visit_shares * visits needed)``
    is a lower bound on the slots a demand takes (it is a feasible dual of the covering problem).
    """
    needy = ~layout.has_power | ~layout.has_comms
    together = jnp.sum(covers & needy, axis=1)
    most = jnp.max(jnp.where(covers, together[:, None], 1), axis=0)
    return jnp.where(needy, 1.0 / most, 0.0)


def best_hover_point(covers: Bool[Array, "n n"], these: Bool[Array, " n"]) -> Int[Array, " n"]:
    """The hover point from which each device is best served: the one that serves most of ``these``."""
    together = jnp.sum(covers & these, axis=1)
    return jnp.argmax(jnp.where(covers, together[:, None], -1), axis=0)


def slot_costs(params: Params, layout: Layout, volumes: Num[Array, "H n"]) -> SlotCosts:
    """Costs of every slot of a volume draw; ``volumes`` in bytes."""
    covers = coverage(params, layout)
    rate = jax.vmap(lambda slant: upload_rate(params, slant))(_slant(params, layout))
    t_compute = jnp.minimum(volumes / layout.processing_rate, params.slot_cap_s)
    t_results = jnp.where(layout.has_comms, 8.0 * params.result_message_bytes / params.uplink_rate_bit_s, 0.0)

    def durations(volumes: Array, busy: Array) -> Array:
        return jnp.max(jnp.where(covers, 8.0 * volumes / rate, busy), axis=1)

    return SlotCosts(
        duration=jax.vmap(durations)(volumes, t_compute + t_results),
        work=layout.active_power * t_compute + params.transmit_power_w * t_results,
        upload=params.transmit_power_w * 8.0 * volumes / jnp.diagonal(rate),
    )


def mean_slot(params: Params, layout: Layout) -> SlotCosts:
    """The slot to expect before its volumes are known; leaves without the leading axis.

    The mean work, ``E[min(v / rate, cap)]`` over uniform volumes, is exact; the length of the slot is that of mean work.
    """
    low, high = (jnp.asarray(bound, jnp.float32) for bound in params.task_volume_range_bytes)
    fits = jnp.clip(params.slot_cap_s * layout.processing_rate, low, high)
    done = 0.5 * (fits**2 - low**2) + (high - fits) * fits
    volumes = jnp.where(high > low, done / jnp.maximum(high - low, 1.0), low)
    return jax.tree.map(lambda leaf: leaf[0], slot_costs(params, layout, volumes[None]))


def idle_drain(layout: Layout, costs: SlotCosts) -> Float[Array, "*H n"]:
    """J that each device's battery loses in a slot, if it is not served and the slot is as short as can be."""
    return layout.standby_power * jnp.min(costs.duration, axis=-1, keepdims=True) + costs.work


@struct.dataclass
class BatteryDemand:
    """What surviving slots ``first .. last - 1`` asks of the batteries.

    Attributes:
        drain: ``[n]`` J, used by each device if it is never served (0 with grid power).
        saved: ``[H + 1, n]`` J, the most that 0, 1, ... H services can save.
        slots: int, the number of slots, ``last - first``.
    """

    drain: Any
    saved: Any
    slots: Any


def battery_demand(layout: Layout, costs: SlotCosts, first: Int[Array, ""] | int, last: Any) -> BatteryDemand:
    """Drain and best savings over the slots ``first .. last - 1``: the largest savings are counted first."""
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
    """Services that keep each battery above zero.

    Returns:
        whole: the least number of services.
        part: the same without rounding up, for comparing states.
        hopeless: not even a service in every slot is enough.
    """
    missing = jnp.where(layout.has_power, -1.0, demand.drain * (1.0 - _ROUNDING) - battery)
    per_step = 1.0 / jnp.maximum(jnp.diff(demand.saved, axis=0), 1e-3)

    def count(visits: Any, counted: tuple[Array, Array]) -> tuple[Array, Array]:
        whole, part = counted
        beyond = missing - demand.saved[visits]
        return whole + (beyond >= 0.0), part + jnp.clip(beyond * per_step[visits], 0.0, 1.0)

    # A loop over the slots that are left: much shorter than the table, which is as long as the longest life.
    whole, part = jax.lax.fori_loop(0, demand.slots, count, (jnp.zeros_like(missing), jnp.zeros_like(missing)))
    return whole, part, missing >= demand.saved[-1]


def age_visits(
    params: Params, layout: Layout, age: Int[Array, "*B n"], slots: Any
) -> tuple[Float[Array, "*B n"], Float[Array, "*B n"]]:
    """Services that keep the data of every device fresh through ``slots`` more slots: whole, and without rounding."""
    turns = jnp.where(layout.has_comms, 0.0, (age + slots) / jnp.maximum(slots_to_expiry(params), 1))
    return jnp.floor(turns), turns


def overdue(
    params: Params, layout: Layout, visit_share: Float[Array, " n"], age: Int[Array, "*B n"], slots: Any
) -> Bool[Array, "*B"]:
    """Whether the data that expire within ``slots`` more slots can no longer all be fetched in time.

    Earliest-deadline test: for every due date, the visit_share visits due by then must fit into the slots until then.
    """
    due = slots_to_expiry(params) - age
    matters = ~layout.has_comms & (due <= slots)
    load = load_by_due(jnp.where(matters, due, jnp.iinfo(jnp.int32).max), visit_share)
    return jnp.any(matters & (load > due + _ROUNDING * 10), axis=-1)


def load_by_due(due: Num[Array, "*B n"], visit_share: Float[Array, " n"]) -> Float[Array, "*B n"]:
    """Charged visits that fall due no later than each entry's own due date."""
    # Entries in rows and one against all at a time: the batch stays the innermost axis, which is what a CPU is fast at.
    rows = jnp.moveaxis(due, -1, 0)
    add = lambda entry, load: load + jnp.where(rows[entry] <= rows, visit_share[entry], 0.0)  # noqa: E731
    return jnp.moveaxis(jax.lax.fori_loop(0, rows.shape[0], add, jnp.zeros(rows.shape)), 0, -1)


def max_by_hover_point(place: Int[Array, " n"], value: Num[Array, "*B n"]) -> Num[Array, "*B n"]:
    """The largest value of the devices that belong to each place; minus :data:`NEVER` where none does."""
    rows = jnp.moveaxis(value, -1, 0)
    lowest = jnp.full(rows.shape, -NEVER, rows.dtype)
    most = lambda device, found: found.at[place[device]].max(rows[device])  # noqa: E731
    return jnp.moveaxis(jax.lax.fori_loop(0, rows.shape[0], most, lowest), 0, -1)


def flight_power(params: Params) -> tuple[Any, Any]:
    """``(base, extra)`` W: a slot costs the UAV at least ``base * duration + extra * flight time``."""
    saved = jnp.where(params.flight_power_adds_to_hover, 0.0, params.uav_hovering_power_w)
    extra = params.uav_flying_power_w - saved
    return params.uav_hovering_power_w + jnp.minimum(extra, 0.0), jnp.maximum(extra, 0.0)

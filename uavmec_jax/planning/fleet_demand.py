"""The demand on a fleet: how short a slot can be, what counting says about lifetimes, and how far planners look ahead.

For one UAV without depots the quantities are those of :mod:`uavmec_jax.planning.demand`. With more UAVs a slot is as short
as if the slowest devices that they can serve together were served, and one visit takes up a ``K``-th of a slot. With
depots, no energy limits a lifetime: a UAV that has landed at one starts into the next slot for nothing, whether it gets
anything there or not. Without depots a UAV hovers in every slot until its energy is used up, so no lifetime is longer
than what one of the batteries pays for.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from uavmec_jax.env.depots import can_help
from uavmec_jax.env.dynamics import State, initial_state
from uavmec_jax.env.fleet import Fleet
from uavmec_jax.env.layout import Layout, fleet_of
from uavmec_jax.env.params import Params
from uavmec_jax.planning import demand
from uavmec_jax.planning.demand import SlotCosts

_ROUNDING = 1e-5
"""Relative tolerance for single precision, always applied in favour of the network."""


def planned_slots(params: Params, layouts: Layout) -> int:
    """Return the number of slots to plan for: a power of two, at least 64, that no lifetime exceeds.

    Args:
        params: leaves ``[B]``.
        layouts: leaves ``[B, n]``.
    """
    needed = int(jnp.max(longest(params, layouts)))
    return max(64, 1 << (needed - 1).bit_length())


@jax.jit
@jax.vmap
def longest(params: Params, layout: Layout) -> Int[Array, ""]:
    """Return the slots ``[B]`` that no lifetime exceeds if each slot is as short as can be; leaves ``[B]``, ``[B, n]``.

    Without depots they are those that one UAV's energy pays for. With several UAVs or depots they are no more than those that
    the batteries of the devices last if all devices are served in every slot.
    """
    least = jnp.full((1, layout.n_devices), params.task_volume_range_bytes[0], jnp.float32)
    costs = slot_costs(params, layout, least)
    shortest = jnp.min(costs.duration)
    fleet = fleet_of(params, layout)
    slots = jnp.asarray(jnp.inf)
    if not layout.n_depots:
        base, _ = demand.flight_power(params, fleet)
        slots = jnp.max(jnp.where(present_uavs(fleet), fleet.battery_j / jnp.maximum(base * shortest, 1e-3), 0.0)) + 2
    if not is_alone(layout):
        drain = layout.standby_power * shortest + jnp.minimum(costs.work, costs.upload)[0]
        drain = jnp.where(layout.has_power, 0.0, drain * (1.0 - _ROUNDING))
        slots = jnp.minimum(slots, jnp.min(layout.capacity / drain) + 2)
    return jnp.minimum(slots, params.max_slots).astype(jnp.int32)


def slot_costs(params: Params, layout: Layout, volumes: Num[Array, "H n"]) -> SlotCosts:
    """Return :func:`demand.slot_costs`, but with slots that no fleet makes shorter, wherever its UAVs hover or land.

    For one UAV without depots they are the same. Otherwise all entries of a slot's ``duration`` are equal.
    """
    costs = demand.slot_costs(params, layout, volumes)
    if is_alone(layout):
        return costs
    shortest = shortest_slots(params, layout, volumes, fleet_size(layout)[None])
    return replace(costs, duration=jnp.broadcast_to(shortest, volumes.shape))


def shortest_slots(
    params: Params, layout: Layout, volumes: Num[Array, "H n"], hover_points: Int[Array, " S"]
) -> Float[Array, "H S"]:
    """Return the length in s of which no slot falls short if UAVs hover above at most so many hover points."""
    t_compute, t_results = demand.work_times(params, layout, volumes)
    t_work, t_upload = t_compute + t_results, 8.0 * volumes / jnp.diagonal(demand.upload_rates(params, layout))
    # No hover point covers shares of more than 1 in total. So of the slowest devices that together make up more shares than
    # there are hover points, at least one is not served.
    share = demand.shares_of(jnp.ones(layout.n_devices, bool), demand.coverage(params, layout))
    slowest_first = jnp.argsort(t_work, axis=1, descending=True)
    too_many = jnp.cumsum(share[slowest_first], axis=1)[..., None] > hover_points * (1.0 + _ROUNDING)
    slowest = jnp.take_along_axis(t_work, slowest_first, axis=1)[..., None]
    unserved = jnp.max(jnp.where(too_many, slowest, 0.0), axis=1)
    return jnp.maximum(unserved, jnp.max(jnp.minimum(t_work, t_upload), axis=1)[:, None])


def slot_shares(layout: Layout, covers: Bool[Array, "n n"]) -> Float[Array, " n"]:
    """Return the share of a slot that a visit to each device takes up: its :func:`demand.visit_shares` by UAVs."""
    return demand.visit_shares(layout, covers) / fleet_size(layout)


def fleet_size(layout: Layout) -> Int[Array, ""]:
    """Return the number of UAVs without padding."""
    return jnp.asarray(1) if layout.fleet is None else jnp.sum(present_uavs(layout.fleet))


def counting_bound(params: Params, layout: Layout, costs: SlotCosts) -> Int[Array, ""]:
    """Return an upper bound on the lifetime by counting: the visits needed must fit into the slots.

    A lifetime of k slots means that k - 1 slots were survived and, without depots, that a UAV's energy sufficed for k.

    Args:
        params: scenario parameters.
        layout: the devices, the UAVs and the depots.
        costs: from :func:`slot_costs`.
    """
    state = initial_state(params, layout)
    slot_share = slot_shares(layout, demand.coverage(params, layout))
    slots = costs.work.shape[0]
    fleet = fleet_of(params, layout)
    base, extra = demand.flight_power(params, fleet)
    to_devices = jnp.linalg.norm(layout.position - fleet.start_m[:, None], axis=-1)
    first_flight = jnp.min(to_devices, axis=1) / fleet.speed_m_s
    shortest = jnp.min(costs.duration, axis=1)
    paid = jax.vmap(lambda base: jnp.cumsum(base * shortest))(base) + (extra * first_flight)[:, None]
    battery = jnp.where(present_uavs(fleet), fleet.battery_j * (1.0 + _ROUNDING), -1.0)

    def feasible(lifetime: Int[Array, ""]) -> Bool[Array, ""]:
        need = demand.battery_demand(layout, costs, 0, lifetime - 1)
        battery_visits, _, infeasible = demand.battery_visits(layout, need, state.battery)
        age_visits, _ = demand.age_visits(params, layout, state.age, lifetime - 1)
        started = lifetime - jnp.where(params.count_unfinished_slot, 1, 0)
        affordable = bool(layout.n_depots) | (started == 0) | jnp.any(paid[:, started - 1] <= battery)
        return (
            affordable
            & ~jnp.any(infeasible)
            & (jnp.sum(slot_share * jnp.maximum(battery_visits, age_visits)) <= lifetime - 1 + 1e-3)
            & ~demand.misses_deadline(params, layout, slot_share, state.age, lifetime - 1)
        )

    lifetimes = jnp.arange(1, slots + 1)
    longest_feasible = jnp.max(jnp.where(jax.lax.map(feasible, lifetimes), lifetimes, 1))
    return jnp.minimum(longest_feasible, params.max_slots).astype(jnp.int32)


def mean_slot(params: Params, layout: Layout) -> SlotCosts:
    """Return :func:`demand.mean_slot` with the duration of :func:`slot_costs`; leaves ``[n]``."""
    return jax.tree.map(lambda leaf: leaf[0], slot_costs(params, layout, demand.mean_volumes(params, layout)[None]))


def visits_in(
    params: Params, layout: Layout, states: State, slots: Num[ArrayLike, ""], shortest: Float[Array, ""]
) -> Float[Array, " *W"]:
    """Return the most visits that the fleet can make from each state in ``slots`` slots of ``shortest`` s or more.

    Where no depot helps, a UAV hovers only as long as its energy lasts.
    """
    base, _ = demand.flight_power(params, fleet_of(params, layout))
    lasts = jnp.floor(states.uav_energy * (1.0 + _ROUNDING) / jnp.maximum(base * shortest, 1e-3))
    each = jnp.where(depots_help(layout, states)[..., None], slots, jnp.minimum(lasts, slots))
    return jnp.sum(jnp.where(states.grounded, 0.0, each), axis=-1)


def depots_help(layout: Layout, states: State) -> Bool[Array, " *W"]:
    """Return whether a depot can still swap or charge in each state."""
    if layout.depots is None:
        return jnp.zeros(states.slot.shape, bool)
    return jnp.any(can_help(layout.depots, states.packs), axis=-1)


def is_alone(layout: Layout) -> bool:
    """Return whether there is one UAV and no depot, as in the paper."""
    return layout.n_uavs == 1 and not layout.n_depots


def present_uavs(fleet: Fleet) -> Bool[Array, " K"]:
    """Return which entries of a fleet are UAVs and not padding."""
    return jnp.ones(fleet.speed_m_s.shape, bool) if fleet.present is None else fleet.present

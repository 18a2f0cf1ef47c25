"""When UAVs return to a depot: before the energy for a slot and the way there is gone, and one after the other.

UAVs that start together run out together. So that they do not all stand at depots while something is due, the returns are
staggered: only a few UAVs return in the same slot, those with the least energy first, early enough for the others.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from uavmec_jax.env.channel import upload_rate
from uavmec_jax.env.depots import can_help, stands_at
from uavmec_jax.env.dynamics import State, slots_to_expiry
from uavmec_jax.env.fleet import DepotKind, Depots, Fleet
from uavmec_jax.env.layout import Layout, fleet_of
from uavmec_jax.env.params import Params
from uavmec_jax.env.slot import result_times

_TOP_UP_SLOTS = 12.0
"""A UAV that nothing needs returns if its energy lasts for fewer slots."""

_LEAVE_AT = 0.8
"""Share of its capacity to which a UAV charges before it leaves a depot."""

_MARGIN = 1e-4
"""Share of its energy that a UAV keeps in hand against rounding."""


class Returns(NamedTuple):
    """Which UAVs return, and to which depots.

    Attributes:
        distance: m, from each UAV to each depot that can help and that its energy reaches; infinite to the others.
        away: slots that each UAV is about to spend on returning: before the data that are fresh now expire.
        full: UAVs to which depots give nothing.
        stays: UAVs that stand at a depot, which goes on charging or swapping their battery.
        urgent: UAVs that return now, whether a pad is free or not.
        must: UAVs that return now if a pad is free.
        may: UAVs that return now if a pad is free and nothing needs them.
        safe: devices from which each UAV still reaches a depot after the longest slot there.
        pads: pads of each depot, less those of the UAVs that stay or have been sent there.
        packs: full batteries in stock at each depot, likewise; infinite where batteries are charged.
    """

    distance: Float[Array, "K D"]
    away: Float[Array, " K"]
    full: Bool[Array, " K"]
    stays: Bool[Array, " K"]
    urgent: Bool[Array, " K"]
    must: Bool[Array, " K"]
    may: Bool[Array, " K"]
    safe: Bool[Array, "K n"]
    pads: Float[Array, " D"]
    packs: Float[Array, " D"]


def plan_returns(params: Params, layout: Layout, state: State, slots_to_go: ArrayLike = jnp.inf) -> Returns | None:
    """Return which UAVs return to a depot in this slot; ``None`` without depots.

    A UAV whose energy lasts for ``slots_to_go`` slots, that is, to the end, does not have to.
    """
    if layout.depots is None:
        return None
    fleet, depots, energy, flies = fleet_of(params, layout), layout.depots, state.uav_energy, ~state.grounded
    helps = can_help(depots, state.packs) & _is_first_of_its_place(depots)
    distance = jnp.linalg.norm(state.uav_position[:, None] - depots.position, axis=-1)
    affordable = energy[:, None] >= fleet.flying_power_w[:, None] * distance / fleet.speed_m_s[:, None]
    distance = jnp.where(helps & affordable & flies[:, None], distance, jnp.inf)
    way_back = jnp.linalg.norm(layout.position[:, None] - depots.position, axis=-1)
    way_back = jnp.min(jnp.where(helps, way_back, jnp.inf), axis=1)
    longest = _longest_slot(params, layout, fleet, state, helps)

    full = energy >= fleet.battery_j
    farthest = jnp.max(jnp.where(_present(layout) & jnp.isfinite(way_back), way_back, 0.0))
    flight, hovering = fleet.flying_power_w * farthest / fleet.speed_m_s, fleet.hovering_power_w * longest
    slots_left = jnp.maximum((energy - 2.0 * flight) / hovering, 0.0)
    wants = jnp.isfinite(jnp.min(distance, axis=1)) & ~full & (slots_left < slots_to_go)
    slots_left = jnp.where(wants, slots_left, jnp.inf)
    full_lasts = jnp.min(jnp.where(flies, (fleet.battery_j - 2.0 * flight) / hovering, jnp.inf))
    refill = jnp.minimum(_refill_slots(params, fleet, depots, distance, wants), full_lasts / jnp.sum(flies))
    refill = jnp.maximum(refill, 1.0)
    together = jnp.clip(jnp.sum(jnp.where(helps, depots.pads, 0.0)), 1, jnp.maximum(1, jnp.sum(flies) // 4))
    turn = jnp.floor(_rank(slots_left) / together) * refill
    # So many UAVs a turn, in the order of their energy: the first ones go if a later one would otherwise have to wait.
    latest = 1.0 + turn * (1.0 + flight / hovering)
    urgent, tight = slots_left < 1.0, jnp.any(slots_left < latest)

    packs = jnp.where(depots.kind == DepotKind.SWAP, jnp.floor(state.packs), jnp.inf)
    low = wants & (energy < _LEAVE_AT * fleet.battery_j)
    gets = stands_at(depots, state.uav_position) & jnp.isfinite(distance) & low[:, None]
    gets &= jnp.cumsum(gets, axis=0) <= jnp.minimum(depots.pads, packs)
    return Returns(
        distance=distance,
        away=jnp.where(slots_left < latest + slots_to_expiry(params), refill, 0.0),
        full=full,
        stays=jnp.any(gets, axis=1),
        urgent=urgent,
        must=urgent | (wants & tight & (turn < 1.0)),
        may=slots_left < _TOP_UP_SLOTS,
        safe=_safe(params, layout, fleet, state, longest, way_back),
        pads=depots.pads - jnp.sum(gets, axis=0),
        packs=packs - jnp.sum(gets, axis=0),
    )


def send(
    layout: Layout, returns: Returns, uav: Int[Array, ""], device: Int[Array, ""], needed: Bool[Array, ""]
) -> tuple[Int[Array, ""], Returns]:
    """Send a UAV that would visit a device there or to a depot; return the place, and what is left for the next UAVs.

    A UAV that could not come back from the device returns as well. If depots give it nothing, it visits the device nearest
    to the chosen one from which it can come back.
    """
    distance, safe = returns.distance[uav], returns.safe[uav]
    stocked = jnp.where(returns.packs >= 1, distance, jnp.inf)
    vacant = jnp.where(returns.pads >= 1, stocked, jnp.inf)
    is_vacant, is_stocked, reaches = (jnp.isfinite(jnp.min(to)) for to in (vacant, stocked, distance))

    detour = jnp.linalg.norm(layout.position - layout.position[device], axis=-1)
    nearest_safe = jnp.argmin(jnp.where(safe, detour, jnp.inf)).astype(jnp.int32)
    stranded = reaches & ~safe[device]
    instead = stranded & returns.full[uav] & jnp.any(safe)
    stranded &= ~instead

    wants = returns.must[uav] | (returns.may[uav] & ~needed)
    goes = ((returns.urgent[uav] | stranded) & is_stocked) | (wants & is_vacant)
    depot = jnp.where(is_vacant, jnp.argmin(vacant), jnp.argmin(stocked))
    takes = goes & ~returns.stays[uav] & (jnp.arange(distance.shape[0]) == depot)
    depot = jnp.where(returns.stays[uav], jnp.argmin(distance), depot)
    place = jnp.where(goes | returns.stays[uav], layout.n_devices + depot, jnp.where(instead, nearest_safe, device))
    return place.astype(jnp.int32), returns._replace(pads=returns.pads - takes, packs=returns.packs - takes)


def _present(layout: Layout) -> Bool[Array, " n"]:
    return jnp.ones(layout.n_devices, bool) if layout.present is None else layout.present


def _is_first_of_its_place(depots: Depots) -> Bool[Array, " D"]:
    """Return whether a UAV at a depot's position stands at it, and not at another one in the same place."""
    return jnp.diagonal(stands_at(depots, depots.position))


def _longest_slot(
    params: Params, layout: Layout, fleet: Fleet, state: State, helps: Bool[Array, " D"]
) -> Float[Array, ""]:
    """Return the seconds that no slot exceeds, wherever the UAVs fly."""
    present, flies = _present(layout), ~state.grounded
    t_results = jnp.max(result_times(params, layout))
    distance = jnp.linalg.norm(layout.places() - state.uav_position[:, None], axis=-1)
    t_fly = distance / fleet.speed_m_s[:, None]
    goals = flies[:, None] & jnp.concatenate([present, helps])
    goals &= fleet.flying_power_w[:, None] * t_fly <= state.uav_energy[:, None]
    longest_flight = jnp.max(jnp.where(goals, t_fly, 0.0))
    highest, lowest = (jnp.where(present[:, None], layout.position, fill) for fill in (-jnp.inf, jnp.inf))
    extent = jnp.linalg.norm(jnp.max(highest, axis=0) - jnp.min(lowest, axis=0))
    slant = jnp.minimum(jnp.max(jnp.where(flies, fleet.signal_range_m, 0.0)), jnp.hypot(extent, params.uav_altitude_m))
    slant = jnp.maximum(slant, params.uav_altitude_m)
    t_upload = 8.0 * params.task_volume_range_bytes[1] / upload_rate(params, slant[None])[0]
    return jnp.maximum(params.slot_cap_s + t_results, longest_flight + t_upload)


def _refill_slots(
    params: Params, fleet: Fleet, depots: Depots, distance: Float[Array, "K D"], wants: Bool[Array, " K"]
) -> Float[Array, ""]:
    """Return the most slots that a UAV spends at its nearest depot: one to swap its battery, more to charge it."""
    charging = jnp.ceil(_LEAVE_AT * fleet.battery_j[:, None] / (depots.power_w * params.slot_cap_s))
    slots = jnp.where(depots.kind == DepotKind.SWAP, 1.0, charging)
    nearest = jnp.arange(depots.kind.shape[0]) == jnp.argmin(distance, axis=1)[:, None]
    return jnp.max(jnp.where(nearest & wants[:, None], slots, 1.0))


def _safe(
    params: Params,
    layout: Layout,
    fleet: Fleet,
    state: State,
    longest: Float[Array, ""],
    way_back: Float[Array, " n"],
) -> Bool[Array, "K n"]:
    """Return the devices from which each UAV still reaches a depot after a slot of ``longest`` s there."""
    distance = jnp.linalg.norm(layout.position - state.uav_position[:, None], axis=-1)
    t_fly, t_back = distance / fleet.speed_m_s[:, None], way_back / fleet.speed_m_s[:, None]
    t_hover = longest - jnp.where(params.flight_power_adds_to_hover, 0.0, t_fly)
    flying, hovering = fleet.flying_power_w[:, None], fleet.hovering_power_w[:, None]
    needed = flying * (t_fly + t_back) + hovering * t_hover
    return _present(layout) & (needed <= state.uav_energy[:, None] * (1.0 - _MARGIN))


def _rank(value: Float[Array, " K"]) -> Int[Array, " K"]:
    """Return each entry's position in ascending order; equal entries keep theirs."""
    index = jnp.arange(value.shape[0])
    before = (value[None, :] < value[:, None]) | (
        (value[None, :] == value[:, None]) & (index[None, :] < index[:, None])
    )
    return jnp.sum(before, axis=1)

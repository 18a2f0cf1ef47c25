"""When UAVs return to a depot: before the energy for a slot and the way there is gone, and one after the other.

UAVs that start together run out together. So that they do not all stand at depots while something is due, the returns are
staggered: only a few UAVs return in the same slot, those with the least energy first, early enough for the others.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from uavmec_jax.env.depots import can_help, stands_at
from uavmec_jax.env.dynamics import State
from uavmec_jax.env.fleet import Fleet
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params

_TOP_UP_SLOTS = 12.0
"""A UAV that nothing needs returns if its energy lasts for fewer slots."""

_LEAVE_AT = 0.8
"""Share of its capacity to which a UAV charges before it leaves a depot."""


class Returns(NamedTuple):
    """Who returns to which depot.

    Attributes:
        depot: place of the nearest depot that can help each UAV.
        must: UAVs that return now.
        may: UAVs that return now if nothing needs them.
        reserve: J, energy that each UAV needs for the way to a depot from each place.
    """

    depot: Int[Array, " K"]
    must: Bool[Array, " K"]
    may: Bool[Array, " K"]
    reserve: Float[Array, "K n_places"]


def plan_returns(params: Params, layout: Layout, fleet: Fleet, state: State) -> Returns | None:
    """Return who returns to a depot in this slot; ``None`` without depots."""
    if layout.depots is None:
        return None
    uavs, places = layout.n_uavs, layout.places()
    helps = can_help(layout.depots, state.packs)
    distances = jnp.linalg.norm(places[:, None] - layout.depots.position, axis=-1)
    reserve = _flight_energy(fleet, jnp.min(jnp.where(helps, distances, jnp.inf), axis=1))
    here = jnp.linalg.norm(state.uav_position[:, None] - layout.depots.position, axis=-1)
    here = jnp.where(helps, here, jnp.inf)
    able = ~state.grounded & (state.uav_energy >= fleet.flying_power_w / fleet.speed_m_s * jnp.min(here, axis=1))

    farthest = jnp.max(jnp.where(jnp.isfinite(reserve), reserve, 0.0)[:, : layout.n_devices], axis=1)
    slots_left = (state.uav_energy - 2.0 * farthest) / (fleet.hovering_power_w * params.slot_cap_s)
    full = state.uav_energy >= fleet.battery_j
    wants = able & ~full
    slots_left = jnp.where(wants, jnp.maximum(slots_left, 0.0), jnp.inf)
    # In the order of their energy, `together` UAVs per slot: the first ones go if a later one would otherwise be too late.
    together = jnp.clip(jnp.sum(jnp.where(helps, layout.depots.pads, 0.0)), 1, max(1, uavs // 4))
    rank = _rank(slots_left)
    turn = jnp.floor(rank / together)
    tight = jnp.any(wants & (slots_left < turn + 1.0))
    must = wants & ((slots_left < 1.0) | (tight & (turn < 1.0)))
    standing = jnp.any(stands_at(layout.depots, state.uav_position) & helps, axis=1)
    must |= wants & standing & (state.uav_energy < _LEAVE_AT * fleet.battery_j)
    return Returns(
        depot=layout.n_devices + jnp.argmin(here, axis=1).astype(jnp.int32),
        must=must,
        may=wants & (slots_left < _TOP_UP_SLOTS),
        reserve=reserve,
    )


def _flight_energy(fleet: Fleet, distance: Float[Array, " m"]) -> Float[Array, "K m"]:
    """Return the energy in J that each UAV needs for each distance in m."""
    return (fleet.flying_power_w / fleet.speed_m_s)[:, None] * distance


def _rank(value: Float[Array, " K"]) -> Int[Array, " K"]:
    """Return each entry's position in ascending order; equal entries keep theirs."""
    index = jnp.arange(value.shape[0])
    before = (value[None, :] < value[:, None]) | (
        (value[None, :] == value[:, None]) & (index[None, :] < index[:, None])
    )
    return jnp.sum(before, axis=1)

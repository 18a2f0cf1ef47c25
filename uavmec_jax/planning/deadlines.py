"""Earliest deadline first over batteries and ages together: the best simple rule that knows no volumes in advance.

Keeping data fresh is pinwheel scheduling (Holte, Mok, Rosier, Tulchinsky and Varvel 1989): a device without
communication wants one slot in every 11. Visits to it have deadlines that return, and serving the earliest deadline is
optimal where any order is (Liu and Layland 1973); with a total density of at most 5/6 such a schedule always exists
(Kawamura 2024). A battery is different: it does not matter when a service comes, only how many come before the end. So
batteries are served in the slots that the ages can spare, and just as many of them as the life that can be hoped for asks.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from uavmec_jax.planning import demand
from uavmec_jax.planning.demand import SlotCosts
from uavmec_jax.world.layout import Layout
from uavmec_jax.world.params import Params
from uavmec_jax.world.physics import State, slots_to_expiry

LOOKAHEAD = 40
"""Slots that the rule looks ahead at most; at the paper's settings the UAV's battery lasts 33."""

_NEVER = 1e6
_TIE_PER_M = 1e-6
"""Equal deadlines go to the nearest device."""


def earliest_deadline(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Visit the battery that empties first if the ages can spare the slot, else the data that expire first.

    How many services the batteries ask for is judged by the longest life that can be hoped for: the number of slots
    into which all visits that are then needed still fit. Where nothing is asked for and the ages can spare the slot,
    the UAV stays where it is.
    """
    covers = demand.coverage(params, layout)
    charged = demand.shares(layout, covers)
    mean = demand.mean_slot(params, layout)
    slots, visits = _hoped_for(params, layout, state, mean, charged)

    away = jnp.linalg.norm(layout.position - state.uav_position, axis=-1)
    due = (slots_to_expiry(params) - state.age).astype(jnp.float32)
    due = jnp.where(layout.has_comms | (due > slots), _NEVER, due)
    spare = _may_spend(covers, charged, due)

    drain = layout.standby_power * jnp.min(mean.duration) + mean.work
    empties = jnp.where(visits > 0, state.battery / jnp.maximum(drain, 1e-6), _NEVER)
    battery = jnp.argmin(jnp.where(spare & (visits > 0), empties + _TIE_PER_M * away, jnp.inf))
    freshness = jnp.argmin(due + _TIE_PER_M * away)
    here = spare & (away <= 0.0)
    rest = jnp.where(jnp.any(here), jnp.argmax(here), freshness)
    return jnp.where(jnp.any(spare & (visits > 0)), battery, rest).astype(jnp.int32)


def _hoped_for(
    params: Params, layout: Layout, state: State, mean: SlotCosts, charged: Float[Array, " n"]
) -> tuple[Any, Float[Array, " n"]]:
    """Slots that may still be survived, and the services that each battery then needs."""
    slots = jnp.arange(1.0, LOOKAHEAD + 1.0)
    shortest = jnp.min(mean.duration)
    drain = layout.standby_power * shortest + mean.work
    saving = jnp.maximum(mean.work - mean.upload, 1e-6)
    missing = slots[:, None] * drain - state.battery
    visits = jnp.where(layout.has_power | (missing < 0.0), 0.0, jnp.floor(missing / saving) + 1.0)
    fresh, _ = demand.age_visits(params, layout, state.age, slots[:, None])
    need = jnp.maximum(visits, fresh)
    base, _ = demand.flight_power(params)
    fits = (
        (need @ charged <= slots)
        & jnp.all(need <= slots[:, None], axis=1)
        & (slots * base * shortest <= state.uav_energy)
    )
    longest = jnp.max(jnp.where(fits, jnp.arange(LOOKAHEAD), 0))
    return slots[longest], visits[longest]


def _may_spend(
    covers: Bool[Array, "n n"], charged: Float[Array, " n"], due: Float[Array, " n"]
) -> Bool[Array, " n"]:
    """Above which devices a slot may be spent: the data of those not served there can still be fetched in time."""
    others = jnp.where(covers, _NEVER, due)
    load = jnp.sum(jnp.where(others[:, None, :] <= others[:, :, None], charged, 0.0), axis=-1)
    return jnp.all((others == _NEVER) | (load + 1.0 <= others + 1e-4), axis=-1)

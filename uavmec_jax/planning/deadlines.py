"""Earliest deadline first over batteries and ages together: the best simple rule that knows no volumes in advance.

Keeping data fresh is pinwheel scheduling (Holte, Mok, Rosier, Tulchinsky and Varvel 1989): a device without
communication wants one slot in every 11. Visits to it have deadlines that return, and serving the earliest deadline is
optimal where any order is (Liu and Layland 1973); with a total density of at most 5/6 such a schedule always exists
(Kawamura 2024). A battery is different: it does not matter when a service comes, only how many come before the end. So
batteries are served in the slots that the ages can spare, and just as many of them as the life that can be hoped for asks.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from uavmec_jax.env.dynamics import State, slots_to_expiry
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning import demand
from uavmec_jax.planning.demand import SlotCosts

LOOKAHEAD = 64
"""Slots that the rule looks ahead at most; at the paper's settings the UAV's battery lasts 33."""

_TIE_PER_M = 1e-6
"""Equal deadlines go to the nearest device."""


def earliest_deadline(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Visit the battery that empties first if the ages can spare the slot, else the data that expire first.

    How many services the batteries ask for is judged by the longest life that can be hoped for: the number of slots
    into which all visits that are then needed still fit. Where nothing is asked for and the ages can spare the slot,
    the UAV stays where it is.
    """
    covers = demand.coverage(params, layout)
    mean = demand.mean_slot(params, layout)
    slots, services = feasible_horizon(params, layout, state, mean, demand.visit_shares(layout, covers))

    away = jnp.linalg.norm(layout.position - state.uav_position, axis=-1)
    due = _due(params, layout, state, covers, slots)
    freshness = jnp.argmin(due + _TIE_PER_M * away)

    drain = demand.idle_drain(layout, mean)
    empties = jnp.where(services > 0, state.battery / jnp.maximum(drain, 1e-6), jnp.inf)
    battery = jnp.argmin(empties + _TIE_PER_M * away)
    here = jnp.where(jnp.min(away) <= 0.0, jnp.argmin(away), freshness)
    spare = jnp.where(jnp.any(services > 0), battery, here)
    return jnp.where(_can_wait(due), spare, freshness).astype(jnp.int32)


def _due(params: Params, layout: Layout, state: State, covers: Bool[Array, "n n"], slots: Any) -> Float[Array, " n"]:
    """Slots until each hover point must be visited; :data:`demand.NEVER` where nothing falls due within ``slots`` slots.

    Every device without communication is fetched from the hover point that serves most of them, so devices that can
    share a visit always do, and share their deadline.
    """
    calls = ~layout.has_comms
    hover = demand.best_hover_point(covers, calls)
    left = (slots_to_expiry(params) - state.age).astype(jnp.float32)
    left = jnp.where(calls & (left <= slots), left, demand.NEVER)
    return jnp.min(jnp.where(hover == jnp.arange(hover.shape[0])[:, None], left, demand.NEVER), axis=1)


def feasible_horizon(
    params: Params, layout: Layout, state: State, mean: SlotCosts, visit_share: Float[Array, " n"]
) -> tuple[Any, Float[Array, " n"]]:
    """Slots that may still be survived, and the services that each battery then needs.

    Args:
        params: scenario parameters.
        layout: the devices.
        state: before the slot.
        mean: the slot to expect, from :func:`demand.mean_slot`.
        visit_share: share of a visit that each device is visit_share with, from :func:`demand.visit_shares`.
    """
    shortest = jnp.min(mean.duration)
    drain = demand.idle_drain(layout, mean)
    per_saving = jnp.where(layout.has_power, 0.0, 1.0 / jnp.maximum(mean.work - mean.upload, 1e-3))
    base, _ = demand.flight_power(params)

    def services(slots: Array) -> Array:
        missing = slots * drain - state.battery
        return jnp.where(missing < 0.0, 0.0, jnp.floor(missing * per_saving) + 1.0) * ~layout.has_power

    def fits(slots: Array) -> Array:
        fresh, _ = demand.age_visits(params, layout, state.age, slots)
        need = jnp.maximum(services(slots), fresh)
        return (need @ visit_share <= slots) & jnp.all(need <= slots) & (slots * base * shortest <= state.uav_energy)

    # Bisection: what fits into a number of slots fits into fewer.
    def halve(step: Any, slots: Array) -> Array:
        longer = slots + LOOKAHEAD / 2.0 ** (step + 1)
        return jnp.where(fits(longer), longer, slots)

    slots = jnp.maximum(jax.lax.fori_loop(0, LOOKAHEAD.bit_length() - 1, halve, jnp.float32(0.0)), 1.0)
    return slots, services(slots)


def _can_wait(due: Float[Array, " n"]) -> Bool[Array, ""]:
    """Whether a slot may be spent on something else: all data can then still be fetched before they expire."""
    load = jnp.sum(due <= due[:, None], axis=-1)
    return jnp.all((due == demand.NEVER) | (load + 1.0 <= due))

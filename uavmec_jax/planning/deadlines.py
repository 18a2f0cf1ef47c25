"""Earliest deadline first over data ages and batteries: the best simple heuristic, without knowledge of future volumes.

*Ages.* Keeping data fresh is pinwheel scheduling (Holte, Mok, Rosier, Tulchinsky and Varvel 1989): at the paper's settings
a device without communication wants one slot in every 11. Its visits have recurring deadlines, and serving the earliest
deadline first is optimal whenever any order is feasible (Liu and Layland 1973). A feasible schedule exists for every total
density of at most 5/6 (Kawamura 2024).

*Batteries.* A battery has no such deadline: it matters how many services come before the end, not when. Batteries are
therefore served in the slots that the ages can spare, and only as often as the longest feasible lifetime requires.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from uavmec_jax.env.dynamics import State, slots_to_expiry
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params, check_params
from uavmec_jax.env.products import product
from uavmec_jax.planning import demand
from uavmec_jax.planning.demand import SlotCosts

LOOKAHEAD = 64
"""Longest horizon in slots; at the paper's settings the UAV's battery lasts for 33."""

_TIE_PER_M = 1e-6
"""Slots per metre: equal deadlines go to the nearest device."""


def earliest_deadline(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Visit the battery that empties first if the ages can spare the slot, else the data that expire first.

    The services that the batteries need are those for the feasible horizon (:func:`feasible_horizon`). If they need none
    and the ages can spare the slot, the UAV stays where it is.

    Raises:
        ArgumentError: a parameter is out of range; one line.
    """
    check_params(params)
    covers = demand.coverage(params, layout)
    mean = demand.mean_slot(params, layout)
    slots, services = feasible_horizon(params, layout, state, mean, demand.visit_shares(layout, covers))

    distance = jnp.linalg.norm(layout.position - state.uav_position[0], axis=-1)
    deadline = _deadlines(params, layout, state, covers, slots)
    freshness = jnp.argmin(deadline + _TIE_PER_M * distance)

    drain = demand.idle_drain(layout, mean)
    empty_in = jnp.where(services > 0, state.battery / jnp.maximum(drain, 1e-6), jnp.inf)
    battery = jnp.argmin(empty_in + _TIE_PER_M * distance)
    stay = jnp.where(jnp.min(distance) <= 0.0, jnp.argmin(distance), freshness)
    spare = jnp.where(jnp.any(services > 0), battery, stay)
    return jnp.where(_can_wait(deadline), spare, freshness).astype(jnp.int32)


def _deadlines(
    params: Params, layout: Layout, state: State, covers: Bool[Array, "n n"], slots: Float[Array, ""]
) -> Float[Array, " n"]:
    """Return the slots until each hover point must be visited; :data:`demand.NEVER` if nothing expires within ``slots``.

    The data of every device without communication are collected from the hover point that covers most such devices, so
    devices that can share a visit always do, and share its deadline.
    """
    disconnected = ~layout.has_comms
    hover_point = demand.best_hover_point(covers, disconnected)
    expiry = (slots_to_expiry(params) - state.age).astype(jnp.float32)
    expiry = jnp.where(disconnected & (expiry <= slots), expiry, demand.NEVER)
    return jnp.min(jnp.where(hover_point == jnp.arange(hover_point.shape[0])[:, None], expiry, demand.NEVER), axis=1)


def feasible_horizon(
    params: Params,
    layout: Layout,
    state: State,
    mean: SlotCosts,
    visit_share: Float[Array, " n"],
    visits_in: Callable[[Float[Array, ""]], Float[Array, ""]] | None = None,
) -> tuple[Float[Array, ""], Float[Array, " n"]]:
    """Return the most slots into which all visits needed to survive them fit, and the services each battery then needs.

    Args:
        params: scenario parameters.
        layout: the devices.
        state: before the slot.
        mean: the expected slot, from :func:`demand.mean_slot`.
        visit_share: share of a visit that each device accounts for, from :func:`demand.visit_shares`.
        visits_in: the most visits that a fleet can make in a number of slots; by default those of the only UAV, one per
            slot as long as its energy lasts.

    Returns:
        Slots, f32 in ``[1, LOOKAHEAD)``, and services ``[n]``, f32 whole numbers.
    """
    shortest = jnp.min(mean.duration)
    drain = demand.idle_drain(layout, mean)
    per_saving = jnp.where(layout.has_power, 0.0, 1.0 / jnp.maximum(mean.work - mean.upload, 1e-3))
    base, _ = demand.flight_power(params)

    def services(slots: Float[Array, ""]) -> Float[Array, " n"]:
        missing = slots * drain - state.battery
        return jnp.where(missing < 0.0, 0.0, jnp.floor(missing * per_saving) + 1.0) * ~layout.has_power

    def fits(slots: Float[Array, ""]) -> Bool[Array, ""]:
        age_visits, _ = demand.age_visits(params, layout, state.age, slots)
        visits = jnp.maximum(services(slots), age_visits)
        if visits_in is not None:
            return (product(visits, visit_share) <= visits_in(slots)) & jnp.all(visits <= slots)
        uav_lasts = slots * base * shortest <= state.uav_energy[0]
        return (product(visits, visit_share) <= slots) & jnp.all(visits <= slots) & uav_lasts

    # Bisection: if the visits fit into a number of slots, then also those for fewer slots.
    def bisect(step: Int[Array, ""], slots: Float[Array, ""]) -> Float[Array, ""]:
        longer = slots + LOOKAHEAD / 2.0 ** (step + 1)
        return jnp.where(fits(longer), longer, slots)

    slots = jnp.maximum(jax.lax.fori_loop(0, LOOKAHEAD.bit_length() - 1, bisect, jnp.float32(0.0)), 1.0)
    return slots, services(slots)


def _can_wait(deadline: Float[Array, " n"]) -> Bool[Array, ""]:
    """Return whether one slot can be spent on something else such that all data can still be collected in time."""
    load = jnp.sum(deadline <= deadline[:, None], axis=-1)
    return jnp.all((deadline == demand.NEVER) | (load + 1.0 <= deadline))

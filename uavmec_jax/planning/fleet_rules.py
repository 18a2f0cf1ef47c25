"""Rules for fleets: one UAV decides at a time and sees which devices are already cared for in this slot."""

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.fleet import UAV_FIELDS, Fleet
from uavmec_jax.env.layout import Layout, fleet_of
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy
from uavmec_jax.planning.returns import Returns, plan_returns


class Choice(NamedTuple):
    """What a UAV would do next.

    Attributes:
        device: index of the device that it would visit.
        needed: whether it is needed there; if not, it may as well return to a depot.
    """

    device: Int[Array, ""]
    needed: Bool[Array, ""]


Chooser = Callable[[Int[Array, ""], Bool[Array, " n"], Bool[Array, " K"]], Choice]
"""``(UAV, devices served so far, UAVs that have not decided yet) -> Choice``."""


def in_turn(
    params: Params, layout: Layout, fleet: Fleet, state: State, returns: Returns | None, choose: Chooser
) -> Int[Array, "*K"]:
    """Let the UAVs decide in turn and return the action: those that must return to a depot do, the others choose.

    A UAV that has to return is not asked; one whose energy does not cover the chosen visit, a slot there and the way to a
    depot returns too.
    """
    covers = coverage_by_uav(params, layout, fleet)
    n, uavs = layout.n_devices, layout.n_uavs
    leaves = jnp.zeros(uavs, bool) if returns is None else returns.must
    undecided = ~state.grounded & ~leaves

    def decide(carry: tuple[Array, Array], uav: Int[Array, ""]) -> tuple[tuple[Array, Array], Int[Array, ""]]:
        served, undecided = carry
        undecided = undecided.at[uav].set(False)
        choice = choose(uav, served, undecided)
        place = choice.device.astype(jnp.int32)
        if returns is not None:
            distance = jnp.linalg.norm(layout.position[place] - state.uav_position[uav])
            flight = fleet.flying_power_w[uav] * distance / fleet.speed_m_s[uav]
            after = state.uav_energy[uav] - flight - fleet.hovering_power_w[uav] * params.slot_cap_s
            home = returns.reserve[uav, place]
            stranded = jnp.isfinite(home) & (after < home) & (state.uav_energy[uav] < fleet.battery_j[uav])
            goes = leaves[uav] | stranded | (~choice.needed & returns.may[uav])
            place = jnp.where(goes, returns.depot[uav], place)
        hovers = (place < n) & ~state.grounded[uav]
        served |= covers(uav, jnp.minimum(place, n - 1)) & hovers
        return (served, undecided), place

    start = (jnp.zeros(n, bool), undecided)
    if uavs == 1:
        return decide(start, jnp.int32(0))[1]
    return jax.lax.scan(decide, start, jnp.arange(uavs))[1]


def coverage_by_uav(
    params: Params, layout: Layout, fleet: Fleet
) -> Callable[[Int[Array, ""], Int[Array, ""]], Bool[Array, " n"]]:
    """Return the function ``(UAV, device) -> devices that it serves from above that device``."""

    def covers(uav: Int[Array, ""], device: Int[Array, ""]) -> Bool[Array, " n"]:
        ground = layout.position - layout.position[device]
        slant = jnp.sqrt(jnp.sum(ground**2, axis=-1) + params.uav_altitude_m**2)
        return (slant <= fleet.signal_range_m[uav]) | (jnp.arange(layout.n_devices) == device)

    return covers


def for_fleets(rule: Policy) -> Policy:
    """Return the policy for any number of UAVs and depots that a rule for one UAV gives.

    UAVs decide in turn by the rule, in a network in which the devices already cared for are fresh and fully charged; their
    slots are numbered on, so that rules that count slots do not send all to the same device. With one UAV and no depots the
    policy is the rule itself.
    """

    @wraps(rule)
    def policy(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
        if layout.n_uavs == 1 and not layout.n_depots:
            return rule(params, layout, state, key)
        fleet = fleet_of(params, layout)

        def choose(uav: Int[Array, ""], served: Bool[Array, " n"], undecided: Bool[Array, " K"]) -> Choice:
            seen = see_as_one(params, layout, fleet, state, uav, served)
            own_key = None if key is None else jax.random.fold_in(key, uav)
            return Choice(rule(*seen, own_key), jnp.asarray(True))

        return in_turn(params, layout, fleet, state, plan_returns(params, layout, fleet, state), choose)

    return policy


def see_as_one(
    params: Params, layout: Layout, fleet: Fleet, state: State, uav: Int[Array, ""], served: Bool[Array, " n"]
) -> tuple[Params, Layout, State]:
    """Return parameters, layout and state as the only UAV would see them, with the devices ``served`` already cared for."""
    own = {f"uav_{name}": getattr(fleet, name)[uav] for name in UAV_FIELDS}
    alone = replace(
        state,
        battery=jnp.where(served, layout.capacity, state.battery),
        age=jnp.where(served, -1, state.age),
        uav_position=state.uav_position[uav][None],
        uav_energy=state.uav_energy[uav][None],
        grounded=state.grounded[uav][None],
        slot=state.slot * layout.n_uavs + uav,
        packs=jnp.zeros(0, jnp.float32),
    )
    return replace(params, **own), replace(layout, fleet=None, depots=None), alone

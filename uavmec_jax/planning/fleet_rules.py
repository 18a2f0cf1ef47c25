"""Rules for fleets: one UAV decides at a time and sees which devices are already cared for in this slot."""

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from uavmec_jax.env.dynamics import State, complete_state, living_devices
from uavmec_jax.env.fleet import UAV_FIELDS
from uavmec_jax.env.layout import Layout, fleet_of
from uavmec_jax.env.padding import mask_absent
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy
from uavmec_jax.env.state_checks import check_decision
from uavmec_jax.planning.fleet_demand import is_alone
from uavmec_jax.planning.returns import Returns, plan_returns, send

_ABSENT_AGE = -2
"""Age at which a rule sees devices that are out for good: below that of the devices already cared for."""


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


def in_turn(params: Params, layout: Layout, state: State, returns: Returns | None, choose: Chooser) -> Int[Array, "*K"]:
    """Let the UAVs decide in turn and return the action: those that have to return to a depot do, the others choose."""
    covers = coverage_by_uav(params, layout)
    n, uavs = layout.n_devices, layout.n_uavs
    undecided = ~state.grounded
    if returns is not None:
        undecided &= ~(returns.must | returns.stays)

    def decide(carry: tuple, uav: Int[Array, ""]) -> tuple[tuple, Int[Array, ""]]:
        served, undecided, returns = carry
        undecided = undecided.at[uav].set(False)
        choice = choose(uav, served, undecided)
        place = choice.device.astype(jnp.int32)
        if returns is not None:
            place, returns = send(layout, returns, uav, place, choice.needed)
        hovers = (place < n) & ~state.grounded[uav]
        served |= covers(uav, jnp.minimum(place, n - 1)) & hovers
        return (served, undecided, returns), place

    start = (jnp.zeros(n, bool), undecided, returns)
    if uavs == 1:
        return decide(start, jnp.int32(0))[1]
    return jax.lax.scan(decide, start, jnp.arange(uavs))[1]


def coverage_by_uav(params: Params, layout: Layout) -> Callable[[Int[Array, ""], Int[Array, ""]], Bool[Array, " n"]]:
    """Return the function ``(UAV, device) -> devices that it serves from above that device``."""
    fleet = fleet_of(params, layout)

    def covers(uav: Int[Array, ""], device: Int[Array, ""]) -> Bool[Array, " n"]:
        ground = layout.position - layout.position[device]
        slant = jnp.sqrt(jnp.sum(ground**2, axis=-1) + params.uav_altitude_m**2)
        return (slant <= fleet.signal_range_m[uav]) | (jnp.arange(layout.n_devices) == device)

    return covers


def for_fleets(rule: Policy) -> Policy:
    """Return the policy for any number of UAVs and depots that a rule for one UAV gives.

    UAVs decide in turn by the rule, in a network in which the devices already cared for are fresh and fully charged; their
    slots are numbered on, so that rules that count slots do not send all to the same device. With one UAV and no depots the
    policy is the rule itself. Where episodes go on after a failure, the rule does not see the devices that are out for good.
    The policy raises ArgumentError if a number of the scenario or the state is out of range.
    """

    @wraps(rule)
    def policy(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
        check_decision(params, layout, state)
        state = complete_state(layout, state)
        living, seen = see_living(params, layout, state)
        if is_alone(layout):
            device = rule(with_uav(params, layout, 0), living, seen, key)
            return device if params.end == "first_failure" else _present_or_first(living, device)

        def choose(uav: Int[Array, ""], served: Bool[Array, " n"], undecided: Bool[Array, " K"]) -> Choice:
            own_key = None if key is None else jax.random.fold_in(key, uav)
            device = rule(*see_as_one(params, living, seen, uav, served), own_key)
            return Choice(_present_or_first(living, device), jnp.asarray(True))

        return in_turn(params, layout, state, plan_returns(params, layout, state), choose)

    return policy


def _present_or_first(layout: Layout, device: Int[Array, ""]) -> Int[Array, ""]:
    """Return the device, or in place of padding the first that is none."""
    return device if layout.present is None else jnp.where(layout.present[device], device, jnp.argmax(layout.present))


def see_living(params: Params, layout: Layout, state: State) -> tuple[Layout, State]:
    """Return layout and state with the devices that are out for good as padding.

    If the first failure ends the episode there are none, and both stay what they are.
    """
    present = living_devices(params, layout, state)
    if present is None:
        return layout, state
    age = jnp.where(present, state.age, _ABSENT_AGE)
    return mask_absent(layout, present), replace(state, battery=jnp.where(present, state.battery, 1.0), age=age)


def see_as_one(
    params: Params, layout: Layout, state: State, uav: Int[Array, ""], served: Bool[Array, " n"]
) -> tuple[Params, Layout, State]:
    """Return parameters, layout and state as the only UAV would see them, with the devices ``served`` already cared for."""
    age = state.age if layout.present is None else jnp.where(layout.present, state.age, _ABSENT_AGE)
    flies = ~state.grounded
    alone = replace(
        state,
        battery=jnp.where(served, layout.capacity, state.battery),
        age=jnp.where(served, -1, age),
        uav_position=state.uav_position[uav][None],
        uav_energy=state.uav_energy[uav][None],
        grounded=state.grounded[uav][None],
        slot=state.slot * jnp.sum(flies) + jnp.sum(flies & (jnp.arange(layout.n_uavs) < uav)),
        packs=jnp.zeros(0, jnp.float32),
    )
    return with_uav(params, layout, uav), replace(layout, fleet=None, depots=None), alone


def with_uav(params: Params, layout: Layout, uav: int | Int[Array, ""]) -> Params:
    """Return the parameters with the speed, powers, battery and range of one UAV of the layout."""
    if layout.fleet is None:
        return params
    return replace(params, **{f"uav_{name}": getattr(layout.fleet, name)[uav] for name in UAV_FIELDS})

"""Earliest deadline first for fleets, and the same with devices that are split among the UAVs.

As for one UAV (:mod:`uavmec_jax.planning.deadlines`), data are collected by their deadlines and batteries are served in what
is left. What is new with ``m`` UAVs in the air: ``m`` visits fit into a slot, but a device gains nothing from two of them.
Batteries are therefore served by least laxity. With a common deadline this means that the battery needing the most services
comes first (Hu's level rule, T. C. Hu, Operations Research 9, 1961). A schedule with all services exists if no battery needs
more of them than there are slots, and all together no more than ``m`` per slot (McNaughton 1959).
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num, PRNGKeyArray

from uavmec_jax.env.dynamics import State, complete_state, initial_state, slots_to_expiry
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.products import product
from uavmec_jax.env.state_checks import check_decision
from uavmec_jax.planning import demand, fleet_demand
from uavmec_jax.planning.deadlines import earliest_deadline as of_one_uav
from uavmec_jax.planning.deadlines import feasible_horizon
from uavmec_jax.planning.fleet_rules import Choice, in_turn, see_living, with_uav
from uavmec_jax.planning.returns import plan_returns

_TIE_PER_M = 1e-6
"""Slots per metre: equal deadlines go to the nearest device."""


class _Needs(NamedTuple):
    """What the devices need before UAVs are sent.

    Attributes:
        covers: whether a UAV above each device serves each other one, with the best range of the fleet.
        hover_point: of each device without communication, the hover point from which its data are collected.
        expires_in: slots until the data expire; :data:`demand.NEVER` if that does not matter.
        services: services that each battery needs to last for the feasible horizon, fractional; negative: energy is left
            over; minus infinity with grid power.
        slots: the feasible horizon.
    """

    covers: Bool[Array, "n n"]
    hover_point: Int[Array, " n"]
    expires_in: Float[Array, " n"]
    services: Float[Array, " n"]
    slots: Float[Array, ""]


def earliest_deadline(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Visit the batteries in need if the ages can spare the visit, else the data that expire first; UAVs decide in turn.

    A UAV that nothing needs serves the battery with the least left over, or returns to a depot if its own runs low. With one
    UAV and no depots the rule is :func:`deadlines.earliest_deadline`.

    Raises:
        ArgumentError: a number of the scenario or the state is out of range; one line.
    """
    check_decision(params, layout, state)
    state = complete_state(layout, state)
    living, seen = _see_living(params, layout, state)
    if fleet_demand.is_alone(layout):
        return of_one_uav(with_uav(params, layout, 0), living, seen, key)
    needs = _needs(params, living, seen)
    returns = plan_returns(params, layout, state, _slots_to_go(params, needs))
    servers = jnp.sum(~state.grounded)
    away = 0.0 if returns is None else jnp.sum(returns.away)

    def choose(uav: Int[Array, ""], served: Bool[Array, " n"], undecided: Bool[Array, " K"]) -> Choice:
        return _choose(living, seen, needs, uav, served, servers, jnp.sum(undecided) - away)

    return in_turn(params, layout, state, returns, choose)


def split_deadline(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Follow the rule of :func:`earliest_deadline`, each UAV for its own devices only.

    The devices are split among the UAVs that still fly (:func:`split_among`).
    """
    if fleet_demand.is_alone(layout):
        return earliest_deadline(params, layout, state, key)
    state = complete_state(layout, state)
    living, seen = _see_living(params, layout, state)
    needs = _needs(params, living, seen)
    returns = plan_returns(params, layout, state, _slots_to_go(params, needs))
    flies = ~state.grounded if returns is None else ~state.grounded & ~(returns.stays | returns.must)
    owner = split_among(params, living, flies)

    def choose(uav: Int[Array, ""], served: Bool[Array, " n"], undecided: Bool[Array, " K"]) -> Choice:
        mine = owner == uav
        own = needs._replace(
            expires_in=jnp.where(mine, needs.expires_in, demand.NEVER),
            services=jnp.where(mine, needs.services, -jnp.inf),
        )
        away = jnp.float32(0.0) if returns is None else returns.away[uav]
        return _choose(living, seen, own, uav, served, jnp.int32(1), -away)

    return in_turn(params, layout, state, returns, choose)


def _see_living(params: Params, layout: Layout, state: State) -> tuple[Layout, State]:
    """Return what :func:`see_living` does, with data that have expired at the limit: how long ago makes no difference."""
    living, seen = see_living(params, layout, state)
    if params.end == "first_failure":
        return living, seen
    return living, replace(seen, age=jnp.minimum(seen.age, slots_to_expiry(params)))


def _slots_to_go(params: Params, needs: _Needs) -> Float[ArrayLike, ""]:
    """Return for how many slots the UAVs are needed: for the feasible horizon, unless episodes go on after a failure."""
    return needs.slots if params.end == "first_failure" else jnp.inf


def split_among(params: Params, layout: Layout, flies: Bool[Array, " K"]) -> Int[Array, " n"]:
    """Split the devices among the UAVs that fly into groups that need about equally many visits; return each one's UAV.

    The groups are sectors around the middle of the devices that need visits. Of all sweeps, one from each device on, that
    with the smallest spread of the groups is taken (Gillett and Miller 1974). Devices that share a hover point stay together.
    """
    needs = _needs(params, layout, initial_state(params, layout))
    needy = ~layout.has_power | ~layout.has_comms
    visits = jnp.clip(needs.services / needs.slots, 0.0, 1.0)
    visits = jnp.maximum(visits, jnp.where(layout.has_comms, 0.0, 1.0 / jnp.maximum(slots_to_expiry(params), 1)))
    together = demand.best_hover_point(needs.covers & needy, needy)
    weight = demand.max_by_hover_point(together, jnp.where(needy, visits + 1e-3, 0.0))
    weight = jnp.maximum(weight, 0.0)  # of each hover point
    middle = jnp.sum(layout.position * weight[:, None], axis=0) / jnp.maximum(jnp.sum(weight), 1e-6)
    east, north = (layout.position - middle).T
    angle = jnp.arctan2(north, east)
    before = jnp.sum(jnp.where(angle[None, :] < angle[:, None], weight, 0.0), axis=1)
    total, groups = jnp.maximum(jnp.sum(weight), 1e-6), jnp.maximum(jnp.sum(flies), 1)

    def sweep(first: Int[Array, ""]) -> tuple[Float[Array, ""], Int[Array, " n"]]:
        turned = before - before[first] + jnp.where(angle < angle[first], total, 0.0)
        share = (turned + 0.5 * weight) / total
        group = jnp.clip(jnp.floor(share * groups), 0, groups - 1).astype(jnp.int32)
        member = jnp.where(group == jnp.arange(flies.shape[0])[:, None], weight, 0.0)
        centre = product(member, layout.position) / jnp.maximum(jnp.sum(member, axis=1, keepdims=True), 1e-6)
        return jnp.sum(weight * jnp.sum((layout.position - centre[group]) ** 2, axis=1)), group

    spread, group = jax.lax.map(sweep, jnp.arange(layout.n_devices))
    best = group[jnp.argmin(jnp.where(weight > 0, spread, jnp.inf))]
    uav_of_group = jnp.argsort(~flies, stable=True)
    return uav_of_group[best[together]]


def _needs(params: Params, layout: Layout, state: State) -> _Needs:
    """Return what the devices need for the longest horizon that the fleet can serve."""
    covers, mean = demand.coverage(params, layout), fleet_demand.mean_slot(params, layout)
    shortest = jnp.min(mean.duration)
    visits_in = lambda slots: fleet_demand.visits_in(params, layout, state, slots, shortest)  # noqa: E731
    slots, _ = feasible_horizon(params, layout, state, mean, demand.visit_shares(layout, covers), visits_in)
    expires_in = (slots_to_expiry(params) - state.age).astype(jnp.float32)
    saving = jnp.maximum(mean.work - mean.upload, 1e-3)
    services = (slots * demand.idle_drain(layout, mean) - state.battery) / saving
    return _Needs(
        covers=covers,
        hover_point=demand.best_hover_point(covers, ~layout.has_comms),
        expires_in=jnp.where(~layout.has_comms & (expires_in <= slots), expires_in, demand.NEVER),
        services=jnp.where(layout.has_power, -jnp.inf, services),
        slots=slots,
    )


def _choose(
    layout: Layout,
    state: State,
    needs: _Needs,
    uav: Int[Array, ""],
    served: Bool[Array, " n"],
    servers: Int[Array, ""],
    others: Num[Array, ""],
) -> Choice:
    """Choose the target of one UAV of ``servers``; ``others`` of them will still decide in this slot."""
    index = jnp.arange(layout.n_devices)
    distance = jnp.linalg.norm(layout.position - state.uav_position[uav], axis=-1)
    at_point = needs.hover_point == index[:, None]
    deadline = jnp.min(jnp.where(at_point & ~served, needs.expires_in, demand.NEVER), axis=1)
    load = jnp.sum(deadline <= deadline[:, None], axis=-1)
    can_wait = jnp.all((deadline == demand.NEVER) | (load <= servers * (deadline - 1.0) + others))
    due = jnp.argmin(deadline + _TIE_PER_M * distance)

    services = jnp.where(served, -jnp.inf, needs.services)
    battery = jnp.argmax(services - _TIE_PER_M * distance)
    needing = jnp.sum(needs.covers & (services > 0), axis=1) + 0.5 * (index == battery)
    above = jnp.argmax(jnp.where(needs.covers[:, battery], needing, -1.0))
    spare = jnp.where(services[battery] > -jnp.inf, above, jnp.argmin(distance))
    return Choice(jnp.where(can_wait, spare, due), ~can_wait | (services[battery] > 0))

"""What the beam search knows of a state: is its target out of reach, how good does it look, which state dominates it."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from uavmec_jax.env.dynamics import State, slots_to_expiry
from uavmec_jax.env.layout import Layout, fleet_of
from uavmec_jax.env.params import Params
from uavmec_jax.env.products import product
from uavmec_jax.planning import demand, fleet_demand
from uavmec_jax.planning.demand import SlotCosts

_LATE_PENALTY = 10.0
"""Subtracted from the score of states whose data are probably too late: they are kept only if there is room."""

ValueFn = Callable[[Params, Layout, State], Float[Array, " W"]]
"""``(params, layout, states [W]) -> [W]`` f32: the values of states that have all completed equally many slots."""


class Problem(NamedTuple):
    """One layout with one volume draw, and the quantities derived from them once per search.

    Attributes:
        params: scenario parameters.
        layout: devices, UAVs and depots.
        volumes: bytes.
        costs: of every slot.
        visit_share: see :func:`demand.visit_shares`.
        hover_point: the hover point of each needy device.
        age_hover_point: the hover point of each device without communication.
        round_length: m, see :func:`_nominal_round_length`.
        value_fn: replaces the score, or ``None``.
    """

    params: Params
    layout: Layout
    volumes: Num[Array, "H n"]
    costs: SlotCosts
    visit_share: Float[Array, " n"]
    hover_point: Int[Array, " n"]
    age_hover_point: Int[Array, " n"]
    round_length: Float[Array, ""]
    value_fn: ValueFn | None


def make_problem(params: Params, layout: Layout, volumes: Num[Array, "H n"], value_fn: ValueFn | None) -> Problem:
    """Return the problem of a search."""
    covers = demand.coverage(params, layout)
    visit_share = demand.visit_shares(layout, covers)
    return Problem(
        params=params,
        layout=layout,
        volumes=volumes,
        costs=fleet_demand.slot_costs(params, layout, volumes),
        visit_share=visit_share,
        hover_point=demand.best_hover_point(covers, ~layout.has_power | ~layout.has_comms),
        age_hover_point=demand.best_hover_point(covers, ~layout.has_comms),
        round_length=_nominal_round_length(layout, visit_share),
        value_fn=value_fn,
    )


def _nominal_round_length(layout: Layout, visit_share: Float[Array, " n"]) -> Float[Array, ""]:
    """Estimate the length in m of a round through the devices without communication, from nearest neighbours."""
    disconnected = ~layout.has_comms
    distance = jnp.linalg.norm(layout.position[:, None] - layout.position[None], axis=-1)
    pairs = disconnected[:, None] & disconnected & ~jnp.eye(disconnected.shape[0], dtype=bool)
    nearest = jnp.min(jnp.where(pairs, distance, jnp.inf), axis=1)
    return jnp.sum(jnp.where(disconnected & jnp.isfinite(nearest), nearest * visit_share, 0.0))


def score(
    problem: Problem, slot: Int[Array, ""], target: Int[Array, ""], states: State
) -> tuple[Float[Array, " W"], Bool[Array, " W"]]:
    """Score states that have completed ``slot`` slots; also return whether the target is provably out of reach.

    The score is the value function's or, by default, minus the sum of two shares that reaching the target takes: the
    visits needed as a share of what is left, and the flights of nominal rounds as a share of the UAVs' spare energy.
    """
    params, layout, visit_share = problem.params, problem.layout, problem.visit_share
    remaining = target - 1 - slot
    need = demand.battery_demand(layout, problem.costs, slot, target - 1)
    battery_visits, battery_exact, infeasible = demand.battery_visits(layout, need, states.battery)
    age_visits, age_exact = demand.age_visits(params, layout, states.age, remaining)
    visits, exact = jnp.maximum(battery_visits, age_visits), jnp.maximum(battery_exact, age_exact - 1.0)
    room, servers, spare, crowded = _what_is_left(problem, slot, target, states, exact)
    lost = (
        jnp.any(infeasible, axis=-1)
        | (product(visits, visit_share) > room + 1e-3)
        | demand.misses_deadline(params, layout, visit_share, states.age, remaining, servers)
        | (spare < 0.0)
    ) & (remaining >= 0)
    if problem.value_fn is not None:
        return problem.value_fn(params, layout, states), lost
    fleet = fleet_of(params, layout)
    _, extra = demand.flight_power(params, fleet)
    expiry = jnp.maximum(slots_to_expiry(params), 1)
    flights = jnp.min(extra * problem.round_length / fleet.speed_m_s) * remaining / expiry
    # Devices that are served from one hover point share their visits.
    shared = jnp.sum(jnp.maximum(demand.max_by_hover_point(problem.hover_point, visits + exact), 0.0), axis=-1)
    pressure = 0.5 * shared / jnp.maximum(room, 1) + flights / jnp.maximum(spare, 1.0) + crowded
    pressure += jnp.where(_probably_late(problem, states.age, remaining, servers), _LATE_PENALTY, 0.0)
    return -pressure, lost


def _what_is_left(
    problem: Problem, slot: Int[Array, ""], target: Int[Array, ""], states: State, exact: Float[Array, "W n"]
) -> tuple[Array, Array | int, Array, Array | float]:
    """Return the visits that the UAVs can still make, how many they make in a slot, and their spare energy in J.

    The last value is, for a fleet, how tight the devices are that need a visit in nearly every slot, since no number of UAVs
    makes two services of a device in one slot count; plus the share of its battery that each device needs at least, which
    tells states apart in which no visits are needed if all slots are as short as can be.
    """
    params, layout = problem.params, problem.layout
    remaining, shortest = target - 1 - slot, jnp.min(problem.costs.duration, axis=1)
    base, _ = demand.flight_power(params, fleet_of(params, layout))
    index = jnp.arange(problem.volumes.shape[0])
    paid = (index >= slot) & (index < target - jnp.where(params.count_unfinished_slot, 1, 0))
    hovering = base * jnp.sum(jnp.where(paid, shortest, 0.0))
    each = states.uav_energy * (1.0 + 1e-5) - hovering
    if fleet_demand.is_alone(layout):
        return remaining, 1, each[:, 0], 0.0
    # Without depots, a UAV that hovers in the last slot has hovered in all slots before.
    longest = jnp.max(jnp.where(states.grounded, -1.0, each), axis=-1)
    spare = jnp.full(longest.shape, jnp.inf) if layout.n_depots else longest
    least = jnp.min(jnp.where((index >= slot) & (index < target - 1), shortest, jnp.inf))
    room = fleet_demand.visits_in(params, layout, states, remaining, least)
    servers = jnp.sum(~states.grounded, axis=-1, keepdims=True)
    tightest = jnp.sum((jnp.maximum(exact, 0.0) / jnp.maximum(remaining, 1)) ** 4, axis=-1)
    ahead = (index >= slot) & (index < target - 1)
    least_drain = layout.standby_power * jnp.sum(jnp.where(ahead, shortest, 0.0)) + jnp.sum(
        jnp.where(ahead[:, None], jnp.minimum(problem.costs.upload, problem.costs.work), 0.0), axis=0
    )
    strain = jnp.where(layout.has_power, 0.0, least_drain / jnp.maximum(states.battery, 1.0))
    return room, servers, spare, tightest + jnp.sum(strain, axis=-1)


def _probably_late(
    problem: Problem, age: Int[Array, "W n"], remaining: Int[Array, ""], servers: Int[Array, "W 1"] | int
) -> Bool[Array, " W"]:
    """Return whether the data cannot all be collected in time if each device keeps to its hover point; not a proof."""
    deadline = slots_to_expiry(problem.params) - age
    deadline = jnp.where(~problem.layout.has_comms & (deadline <= remaining), deadline, demand.NEVER)
    first = -demand.max_by_hover_point(problem.age_hover_point, -deadline)
    load = demand.load_by_deadline(first, jnp.ones(first.shape[-1]))
    return jnp.any((first < demand.NEVER) & (load > first * servers), axis=-1)


def dominated(layout: Layout, states: State, place: Int[Array, "W *K"], alive: Bool[Array, " W"]) -> Bool[Array, " W"]:
    """Return whether another state with the UAVs in the same places is at least as good in every criterion.

    The criteria are all ages, batteries, the UAVs' energies and the packs. Of equal states the first is not dominated. Ages
    of connected and batteries of powered devices do not count.
    """
    age = jnp.where(layout.has_comms, 0, states.age).astype(jnp.float32)
    battery = jnp.where(layout.has_power, 0.0, states.battery)
    criteria = jnp.concatenate([-age, battery, states.uav_energy, states.packs], axis=1)
    columns, rank = criteria.T, jnp.arange(place.shape[0])
    same = _same_places(place, states.grounded)

    # One state against all others at a time, criteria in rows: eight times as fast as all pairs at once.
    def compare(other: Int[Array, ""], dominated: Bool[Array, " W"]) -> Bool[Array, " W"]:
        as_good, better = same(other) & alive[other], other < rank
        for criterion in range(criteria.shape[1]):
            as_good &= columns[criterion] <= criteria[other, criterion]
            better |= columns[criterion] < criteria[other, criterion]
        return dominated | (as_good & better)

    return jax.lax.fori_loop(0, place.shape[0], compare, jnp.zeros(place.shape[0], bool))


def _same_places(
    place: Int[Array, "W *K"], grounded: Bool[Array, "W K"]
) -> Callable[[Int[ArrayLike, ""]], Bool[Array, " W"]]:
    """Return the function that tells which states have the UAVs in the same places as a given one, the same ones grounded."""
    if place.ndim == 1:
        return lambda other: place == place[other]
    return lambda other: jnp.all((place == place[other]) & (grounded == grounded[other]), axis=-1)

"""Clairvoyant beam search: the longest lifetime that a tour reaches if all task volumes are known in advance.

No policy in the field knows the volumes of later slots. The search tells how good a tour there was, and together with
:func:`uavmec_jax.planning.bound.upper_bound` how much better any tour could have been.

The search tries to reach a *target* lifetime. Slot by slot, it visits every device from every state of the beam and prunes

1. the states from which the target is provably out of reach: more visits are needed than slots remain, data would expire,
   or the UAV's energy does not last;
2. the states that another state at the same hover point dominates: no older data, no less battery, no less UAV energy;
3. all but the ``width`` states with the highest score, which is that of the states from which the devices need the fewest
   visits to reach the target.

The first target is an upper bound on the lifetime; it is lowered by one slot until a tour reaches it. Only rule 3 is
heuristic, the other two prune with a proof, so a beam that is wide enough finds the optimum.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from uavmec_jax.env.dynamics import Cause, Outcome, State, initial_state, slots_to_expiry, transition
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning import demand
from uavmec_jax.planning.demand import SlotCosts
from uavmec_jax.planning.fleet_demand import counting_bound

WIDTH = 64
"""States kept per slot by default. A beam four times as wide lengthens one lifetime in 400, by one slot."""

_LATE_PENALTY = 10.0
"""Subtracted from the score of states whose data are probably too late: they are kept only if there is room."""


@struct.dataclass
class Tour:
    """A tour and the lifetime that the network reaches with it.

    Attributes:
        lifetime: int32, slots.
        actions: ``[H]`` int32, device visited in each slot; -1 after the end.
        bound: int32, slots, the first target of the search: an upper bound on the lifetime of any tour.
    """

    lifetime: Int[Array, "*batch"]
    actions: Int[Array, "*batch H"]
    bound: Int[Array, "*batch"]


class _Beam(NamedTuple):
    """The states after ``slot`` slots, leaves ``[W, ...]``, their tours so far, and the best tour that has ended."""

    slot: Int[Array, ""]
    states: State
    alive: Bool[Array, " W"]
    tours: Int[Array, "W H"]
    lifetime: Int[Array, ""]
    best_tour: Int[Array, " H"]


ValueFn = Callable[[Params, Layout, State], Float[Array, " W"]]
"""``(params, layout, states [W]) -> [W]`` f32: the values of states that have all completed equally many slots."""


class _Problem(NamedTuple):
    """One layout with one volume draw, and the quantities derived from them once per search."""

    params: Params
    layout: Layout
    volumes: Num[Array, "H n"]
    costs: SlotCosts
    visit_share: Float[Array, " n"]
    hover_point: Int[Array, " n"]
    age_hover_point: Int[Array, " n"]
    round_length: Float[Array, ""]
    value_fn: ValueFn | None


def beam_search(
    params: Params,
    layout: Layout,
    volumes: Num[Array, "H n"],
    width: int = WIDTH,
    upper_bound: Int[ArrayLike, ""] | None = None,
    value_fn: ValueFn | None = None,
) -> Tour:
    """Return the tour with the longest lifetime that the beam finds; clairvoyant in ``volumes``.

    Args:
        params: scenario parameters.
        layout: the devices.
        volumes: bytes, the tasks of every slot; ``H`` from :func:`uavmec_jax.planning.fleet_demand.horizon`.
        width: states kept per slot; static.
        upper_bound: slots, a known upper bound on the lifetime, from which the search then starts.
        value_fn: scores the states that are not pruned with a proof, e.g. a learned critic; by default, the score is
            high where the visits still needed take a small share of the remaining slots.
    """
    chex.assert_shape(volumes, (None, layout.capacity.shape[0]))
    costs = demand.slot_costs(params, layout, volumes)
    covers = demand.coverage(params, layout)
    visit_share = demand.visit_shares(layout, covers)
    hover_point = demand.best_hover_point(covers, ~layout.has_power | ~layout.has_comms)
    age_hover_point = demand.best_hover_point(covers, ~layout.has_comms)
    round_length = _nominal_round_length(layout, visit_share)
    problem = _Problem(
        params, layout, volumes, costs, visit_share, hover_point, age_hover_point, round_length, value_fn
    )
    bound = counting_bound(params, layout, costs)
    bound = bound if upper_bound is None else jnp.minimum(bound, upper_bound)

    def attempt(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        target, lifetime, actions = carry
        beam = _search(problem, target, width)
        improved = beam.lifetime > lifetime
        return target - 1, jnp.maximum(beam.lifetime, lifetime), jnp.where(improved, beam.best_tour, actions)

    no_visits = jnp.full(volumes.shape[:1], -1, jnp.int32)
    # A failed attempt may still have reached the next lower target, which then needs no attempt of its own.
    _, lifetime, actions = jax.lax.while_loop(
        lambda carry: carry[1] < carry[0], attempt, (bound, jnp.int32(0), no_visits)
    )
    return Tour(lifetime=lifetime, actions=actions, bound=bound)


def _nominal_round_length(layout: Layout, visit_share: Float[Array, " n"]) -> Float[Array, ""]:
    """Estimate the length in m of a round through the devices without communication, from nearest neighbours."""
    disconnected = ~layout.has_comms
    distance = jnp.linalg.norm(layout.position[:, None] - layout.position[None], axis=-1)
    pairs = disconnected[:, None] & disconnected & ~jnp.eye(disconnected.shape[0], dtype=bool)
    nearest = jnp.min(jnp.where(pairs, distance, jnp.inf), axis=1)
    return jnp.sum(jnp.where(disconnected & jnp.isfinite(nearest), nearest * visit_share, 0.0))


def _search(problem: _Problem, target: Int[Array, ""], width: int) -> _Beam:
    """Make one attempt: advance slot by slot until the target is reached or no state is left."""
    slots = problem.volumes.shape[0]
    start = initial_state(problem.params, problem.layout)
    beam = _Beam(
        slot=jnp.int32(0),
        states=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (width, *leaf.shape)), start),
        alive=jnp.arange(width) == 0,
        tours=jnp.full((width, slots), -1, jnp.int32),
        lifetime=jnp.int32(0),
        best_tour=jnp.full((slots,), -1, jnp.int32),
    )
    unfinished = lambda beam: (beam.lifetime < target) & jnp.any(beam.alive) & (beam.slot < slots)  # noqa: E731
    return jax.lax.while_loop(unfinished, partial(_advance, problem, target, width), beam)


def _advance(problem: _Problem, target: Int[Array, ""], width: int, beam: _Beam) -> _Beam:
    """Visit every device from every state and keep the states with the highest scores that no other dominates."""
    params, layout = problem.params, problem.layout
    n = layout.capacity.shape[0]
    after, outcome = visit_all(params, layout, beam.states, problem.volumes[beam.slot])

    lifetimes = jnp.where(beam.alive[:, None], after.slot, 0).reshape(-1)
    best = jnp.argmax(lifetimes)
    best_tour = beam.tours[best // n].at[beam.slot].set(best % n)
    improved = lifetimes[best] > beam.lifetime

    survives = (beam.alive[:, None] & (outcome.cause == Cause.NONE) & (after.slot < params.max_slots)).reshape(-1)
    after = jax.tree.map(lambda leaf: leaf.reshape(width * n, *leaf.shape[2:]), after)
    score = jnp.where(survives, _score(problem, beam.slot + 1, target, after), -jnp.inf)
    # The dominance test gets half as many states again, so that those it removes leave no gaps in the beam.
    score, chosen = jax.lax.top_k(score, min(width + width // 2, n * width))
    candidates = jax.tree.map(lambda leaf: leaf[chosen], after)
    score = jnp.where(_dominated(layout, candidates, chosen % n, score > -jnp.inf), -jnp.inf, score)
    score, kept = jax.lax.top_k(score, width)
    chosen = chosen[kept]
    return _Beam(
        slot=beam.slot + 1,
        states=jax.tree.map(lambda leaf: leaf[kept], candidates),
        alive=score > -jnp.inf,
        tours=beam.tours[chosen // n].at[:, beam.slot].set(chosen % n),
        lifetime=jnp.where(improved, lifetimes[best], beam.lifetime),
        best_tour=jnp.where(improved, best_tour, beam.best_tour),
    )


def visit_all(params: Params, layout: Layout, states: State, volumes: Num[Array, " n"]) -> tuple[State, Outcome]:
    """Visit every device from every state: leaves ``[W, ...]`` become ``[W, n, ...]``."""
    visit = jax.vmap(lambda state, action: transition(params, layout, state, action, volumes), (None, 0))
    return jax.vmap(visit, (0, None))(states, jnp.arange(volumes.shape[0]))


def _score(problem: _Problem, slot: Int[Array, ""], target: Int[Array, ""], states: State) -> Float[Array, " W"]:
    """Score states that have completed ``slot`` slots; minus infinity if the target is provably out of reach.

    The score is the value function's or, by default, minus the sum of two shares that reaching the target takes: the
    visits needed as a share of the remaining slots, and the flights of nominal rounds as a share of the UAV's spare energy.
    """
    params, layout, visit_share = problem.params, problem.layout, problem.visit_share
    remaining = target - 1 - slot
    need = demand.battery_demand(layout, problem.costs, slot, target - 1)
    battery_visits, battery_exact, infeasible = demand.battery_visits(layout, need, states.battery)
    age_visits, age_exact = demand.age_visits(params, layout, states.age, remaining)
    visits, exact = jnp.maximum(battery_visits, age_visits), jnp.maximum(battery_exact, age_exact - 1.0)

    base, extra = demand.flight_power(params)
    index = jnp.arange(problem.volumes.shape[0])
    paid = (index >= slot) & (index < target - jnp.where(params.count_unfinished_slot, 1, 0))
    hovering = base * jnp.sum(jnp.where(paid, jnp.min(problem.costs.duration, axis=1), 0.0))
    spare = states.uav_energy[:, 0] * (1.0 + 1e-5) - hovering
    expiry = jnp.maximum(slots_to_expiry(params), 1)
    flights = extra * problem.round_length / params.uav_speed_m_s * remaining / expiry

    lost = (
        jnp.any(infeasible, axis=-1)
        | (visits @ visit_share > remaining + 1e-3)
        | demand.misses_deadline(params, layout, visit_share, states.age, remaining)
        | (spare < 0.0)
    )
    if problem.value_fn is not None:
        return jnp.where(lost & (remaining >= 0), -jnp.inf, problem.value_fn(params, layout, states))
    # Devices that are served from one hover point share their visits.
    shared = jnp.sum(jnp.maximum(demand.max_by_hover_point(problem.hover_point, visits + exact), 0.0), axis=-1)
    pressure = 0.5 * shared / jnp.maximum(remaining, 1) + flights / jnp.maximum(spare, 1.0)
    pressure += jnp.where(_probably_late(problem, states.age, remaining), _LATE_PENALTY, 0.0)
    return jnp.where(lost & (remaining >= 0), -jnp.inf, -pressure)


def _probably_late(problem: _Problem, age: Int[Array, "W n"], remaining: Int[Array, ""]) -> Bool[Array, " W"]:
    """Return whether the data cannot all be collected in time if each device keeps to its hover point; not a proof."""
    deadline = slots_to_expiry(problem.params) - age
    deadline = jnp.where(~problem.layout.has_comms & (deadline <= remaining), deadline, demand.NEVER)
    first = -demand.max_by_hover_point(problem.age_hover_point, -deadline)
    load = demand.load_by_deadline(first, jnp.ones(first.shape[-1]))
    return jnp.any((first < demand.NEVER) & (load > first), axis=-1)


def _dominated(
    layout: Layout, states: State, hover_point: Int[Array, " W"], alive: Bool[Array, " W"]
) -> Bool[Array, " W"]:
    """Return whether another state at the same hover point is at least as good in every age, battery and UAV energy.

    Of equal states the first is not dominated. Ages of connected and batteries of powered devices do not count.
    """
    age = jnp.where(layout.has_comms, 0, states.age).astype(jnp.float32)
    battery = jnp.where(layout.has_power, 0.0, states.battery)
    criteria = jnp.concatenate([-age, battery, states.uav_energy], axis=1)
    columns, rank = criteria.T, jnp.arange(hover_point.shape[0])

    # One state against all others at a time, criteria in rows: eight times as fast as all pairs at once.
    def compare(other: Int[Array, ""], dominated: Bool[Array, " W"]) -> Bool[Array, " W"]:
        as_good, better = (hover_point == hover_point[other]) & alive[other], other < rank
        for criterion in range(criteria.shape[1]):
            as_good &= columns[criterion] <= criteria[other, criterion]
            better |= columns[criterion] < criteria[other, criterion]
        return dominated | (as_good & better)

    return jax.lax.fori_loop(0, hover_point.shape[0], compare, jnp.zeros(hover_point.shape, bool))

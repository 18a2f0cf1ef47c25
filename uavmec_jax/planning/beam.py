"""Clairvoyant beam search: the longest lifetime that a tour reaches if all task volumes are known in advance.

No policy in the field knows the volumes of later slots. The search tells how good a tour there was, and together with
:func:`uavmec_jax.planning.bound.upper_bound` how much better any tour could have been.

The search tries to reach a *target* lifetime. Slot by slot, it tries the actions from every state of the beam and prunes

1. the states from which the target is provably out of reach: more visits are needed than slots remain, data would expire,
   or the UAV's energy does not last;
2. the states that another state with the UAVs in the same places dominates: no older data, no less battery or UAV energy;
3. all but the ``width`` states with the highest score, which is that of the states from which the devices need the fewest
   visits to reach the target;
4. for fleets, whose actions are decided one UAV at a time, all but the partly decided actions with the highest scores.

The first target is an upper bound on the lifetime; it is lowered by one slot until a tour reaches it. Rules 3 and 4 are
heuristic, the other two prune with a proof, so a beam that is wide enough finds the optimum. (In a fleet with hardware whose
uploads take longer than computing, rule 2 is heuristic as well.)
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Int, Num

from uavmec_jax.env.checks import check_range
from uavmec_jax.env.dynamics import Cause, Outcome, State, initial_state, transition
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.scenario_checks import check_scenario
from uavmec_jax.env.slot_checks import check_volume_table
from uavmec_jax.planning.beam_score import Problem, ValueFn, dominated, make_problem, score
from uavmec_jax.planning.fleet_deadlines import earliest_deadline
from uavmec_jax.planning.fleet_demand import counting_bound

_MOST_STATES = 1_000_000
"""Largest width."""

WIDTH = 64
"""States kept per slot by default. A beam four times as wide lengthens one lifetime in 400, by one slot."""

_LOST = 1e4
"""Subtracted from the score of partly decided actions that seem to lose: the UAVs left may still save them."""

_PARTIAL = 20_000_000
"""Numbers, of places times devices, that decide how many partly decided actions of a fleet are kept (:func:`_actions`)."""


@struct.dataclass
class Tour:
    """A tour and the lifetime that the network reaches with it.

    Attributes:
        lifetime: int32, slots.
        actions: int32, the action of each slot, ``[H]`` for one UAV and ``[H, K]`` for a fleet; -1 after the end.
        bound: int32, slots, the first target of the search: an upper bound on the lifetime of any tour.
    """

    lifetime: Int[Array, "*batch"]
    actions: Int[Array, "*batch_H_K"]
    bound: Int[Array, "*batch"]


class _Beam(NamedTuple):
    """The states after ``slot`` slots, leaves ``[W, ...]``, their tours so far, and the best tour that has ended."""

    slot: Int[Array, ""]
    states: State
    alive: Bool[Array, " W"]
    tours: Int[Array, "W H *K"]
    lifetime: Int[Array, ""]
    best_tour: Int[Array, "H *K"]


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
        volumes: bytes, the tasks of every slot; ``H`` from :func:`fleet_demand.planned_slots`.
        width: states kept per slot; static.
        upper_bound: slots, a known upper bound on the lifetime, from which the search then starts.
        value_fn: scores the states that are not pruned with a proof, e.g. a learned critic; by default, the score is
            high where the visits still needed take a small share of the remaining slots.

    Raises:
        ArgumentError: a parameter, a volume, a value of the layout or the width is out of range; one line.
        ValueError: episodes do not end with the first failure.
    """
    check_scenario(params, layout)
    check_volume_table(volumes, layout.n_devices)
    volumes = jnp.asarray(volumes)  # of NumPy, they could not be indexed with a traced slot
    check_range("width", width, ge=1, le=_MOST_STATES, whole=True)
    if params.end != "first_failure":
        raise ValueError(f"end is {params.end!r}; the beam searches for the longest time to the 'first_failure'")
    problem = make_problem(params, layout, volumes, value_fn)
    bound = counting_bound(params, layout, problem.costs)
    bound = bound if upper_bound is None else jnp.minimum(bound, upper_bound)

    def attempt(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        target, lifetime, actions = carry
        beam = _search(problem, target, width)
        improved = beam.lifetime > lifetime
        return target - 1, jnp.maximum(beam.lifetime, lifetime), jnp.where(improved, beam.best_tour, actions)

    no_visits = jnp.full((volumes.shape[0], *layout.action_shape), -1, jnp.int32)
    # A failed attempt may still have reached the next lower target, which then needs no attempt of its own.
    _, lifetime, actions = jax.lax.while_loop(
        lambda carry: carry[1] < carry[0], attempt, (bound, jnp.int32(0), no_visits)
    )
    return Tour(lifetime=lifetime, actions=actions, bound=bound)


def _search(problem: Problem, target: Int[Array, ""], width: int) -> _Beam:
    """Make one attempt: advance slot by slot until the target is reached or no state is left."""
    slots = problem.volumes.shape[0]
    start = initial_state(problem.params, problem.layout)
    beam = _Beam(
        slot=jnp.int32(0),
        states=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (width, *leaf.shape)), start),
        alive=jnp.arange(width) == 0,
        tours=jnp.full((width, slots, *problem.layout.action_shape), -1, jnp.int32),
        lifetime=jnp.int32(0),
        best_tour=jnp.full((slots, *problem.layout.action_shape), -1, jnp.int32),
    )
    unfinished = lambda beam: (beam.lifetime < target) & jnp.any(beam.alive) & (beam.slot < slots)  # noqa: E731
    return jax.lax.while_loop(unfinished, partial(_advance, problem, target, width), beam)


def _advance(problem: Problem, target: Int[Array, ""], width: int, beam: _Beam) -> _Beam:
    """Try actions from every state and keep the states with the highest scores that no other dominates."""
    params, layout, volumes = problem.params, problem.layout, problem.volumes[beam.slot]
    parent, action, alive = _actions(problem, target, beam)
    if layout.n_uavs == 1:
        tried = visit_all(params, layout, beam.states, volumes)
        after, outcome = jax.tree.map(lambda leaf: leaf.reshape(len(parent), *leaf.shape[2:]), tried)
    else:
        after, outcome = _take(problem, beam, parent, action)

    lifetimes = jnp.where(alive, after.slot, 0)
    best = jnp.argmax(lifetimes)
    best_tour = beam.tours[parent[best]].at[beam.slot].set(action[best])
    improved = lifetimes[best] > beam.lifetime

    survives = alive & (outcome.cause == Cause.NONE) & (after.slot < params.max_slots)
    value, lost = score(problem, beam.slot + 1, target, after)
    value = jnp.where(survives & ~lost, value, -jnp.inf)
    # The dominance test gets half as many states again, so that those it removes leave no gaps in the beam.
    value, chosen = jax.lax.top_k(value, min(width + width // 2, len(parent)))
    candidates = jax.tree.map(lambda leaf: leaf[chosen], after)
    value = jnp.where(dominated(layout, candidates, action[chosen], value > -jnp.inf), -jnp.inf, value)
    value, kept = jax.lax.top_k(value, width)
    chosen = chosen[kept]
    return _Beam(
        slot=beam.slot + 1,
        states=jax.tree.map(lambda leaf: leaf[kept], candidates),
        alive=value > -jnp.inf,
        tours=beam.tours[parent[chosen]].at[:, beam.slot].set(action[chosen]),
        lifetime=jnp.where(improved, lifetimes[best], beam.lifetime),
        best_tour=jnp.where(improved, best_tour, beam.best_tour),
    )


class _Actions(NamedTuple):
    """``C`` actions to try: the state of the beam that each starts from, the action, and whether it is to be tried."""

    parent: Int[Array, " C"]
    action: Int[Array, "C *K"]
    alive: Bool[Array, " C"]


def _actions(problem: Problem, target: Int[Array, ""], beam: _Beam) -> _Actions:
    """Return the actions to try from the states of the beam: all of one UAV; those of a fleet one UAV at a time.

    Of the actions in which the first UAVs have decided and the others do what the earliest-deadline rule would, those with
    the best results go on to the next UAV.
    """
    layout, width = problem.layout, beam.alive.shape[0]
    start = _Actions(jnp.arange(width), jnp.zeros((width, *layout.action_shape), jnp.int32), beam.alive)
    if layout.n_uavs == 1:
        return _decide(layout, start, 0)
    rule = jax.vmap(lambda state: earliest_deadline(problem.params, layout, state))
    actions = _decide(layout, start._replace(action=rule(beam.states)), 0)
    kept = max(width, min(width * layout.n_places, _PARTIAL // (layout.n_places * layout.n_devices)))
    kept = min(kept, width * layout.n_places)

    def next_uav(uav: Int[Array, ""] | int, actions: _Actions) -> _Actions:
        return _decide(layout, _most_promising(problem, target, beam, actions, kept), uav)

    actions = next_uav(1, actions)
    return jax.lax.fori_loop(2, layout.n_uavs, next_uav, actions) if layout.n_uavs > 2 else actions


def _decide(layout: Layout, actions: _Actions, uav: Int[Array, ""] | int) -> _Actions:
    """Return every action with each place as the target of a UAV."""
    repeat = lambda leaf: jnp.repeat(leaf, layout.n_places, axis=0)  # noqa: E731
    place = jnp.tile(jnp.arange(layout.n_places, dtype=jnp.int32), actions.parent.shape[0])
    action = place if layout.n_uavs == 1 else repeat(actions.action).at[:, uav].set(place)
    return _Actions(repeat(actions.parent), action, repeat(actions.alive))


def _most_promising(problem: Problem, target: Int[Array, ""], beam: _Beam, actions: _Actions, count: int) -> _Actions:
    """Return the ``count`` actions with the best results, whether or not the target is then out of reach."""
    if len(actions.parent) <= count:
        return actions
    after, outcome = _take(problem, beam, actions.parent, actions.action)
    value, lost = score(problem, beam.slot + 1, target, after)
    value -= jnp.where(lost, _LOST, 0.0) + jnp.where(outcome.cause == Cause.NONE, 0.0, _LOST)
    chosen = jax.lax.top_k(jnp.where(actions.alive, value, -jnp.inf), count)[1]
    return jax.tree.map(lambda leaf: leaf[chosen], actions)


def _take(problem: Problem, beam: _Beam, parent: Int[Array, " C"], action: Int[Array, "C K"]) -> tuple[State, Outcome]:
    """Take each action from its state of the beam."""
    volumes = problem.volumes[beam.slot]
    take = jax.vmap(lambda state, action: transition(problem.params, problem.layout, state, action, volumes))
    return take(jax.tree.map(lambda leaf: leaf[parent], beam.states), action)


def visit_all(params: Params, layout: Layout, states: State, volumes: Num[Array, " n"]) -> tuple[State, Outcome]:
    """Send the only UAV from every state to every place: leaves ``[W, ...]`` become ``[W, n + D, ...]``."""
    visit = jax.vmap(lambda state, action: transition(params, layout, state, action, volumes), (None, 0))
    return jax.vmap(visit, (0, None))(states, jnp.arange(layout.n_places))

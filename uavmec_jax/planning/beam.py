"""Beam search that knows every volume in advance: how long the network could have lived.

Clairvoyant: no policy in the field can know the volumes of later slots. It says how good a tour there was, and with
:func:`uavmec_jax.planning.bound.upper_bound` how much better any tour could have been.

The search aims at a lifetime: it keeps the states from which the devices still need the fewest visits to get there,
drops those that provably cannot, and those that another state at the same place dominates. It starts at a lifetime that
cannot be passed and takes one slot off the aim until it succeeds. All that it drops for good, it drops with a proof, so
a beam that is wide enough finds the optimum.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Num

from uavmec_jax.env.dynamics import Cause, Outcome, State, initial_state, slots_to_expiry, transition
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning import demand
from uavmec_jax.planning.demand import SlotCosts

WIDTH = 64
"""States kept per slot by default. Four times as many lengthen one life in 400 by a slot."""

_BUNCHED = 10.0
"""Pressure added to states whose data are bunched too closely: they are kept only if there is room."""


@struct.dataclass
class Tour:
    """A tour and how long the network lives with it.

    Attributes:
        lifetime: int32, slots.
        actions: ``[H]`` int32, device visited in each slot; -1 after the end.
        aim: int32, the lifetime that the search began with: no tour passes it.
    """

    lifetime: Any
    actions: Any
    aim: Any


class _Beam(NamedTuple):
    """The states after ``slot`` slots: leaves ``[W, ...]``, and the longest life seen so far."""

    slot: Any
    states: State
    alive: Any
    tours: Any
    lifetime: Any
    best: Any


ValueFn = Callable[[Params, Layout, State], Array]
"""``(params, layout, states [W]) -> [W]`` f32: how promising states are, all after equally many slots."""


class _Problem(NamedTuple):
    """One layout with one volume draw, and what is worked out about it once."""

    params: Params
    layout: Layout
    volumes: Any
    costs: SlotCosts
    visit_share: Any
    hover: Any
    calls_from: Any
    round_m: Any
    value_fn: ValueFn | None


def horizon(params: Params, layouts: Layout) -> int:
    """Slots to plan for: a power of two (at least 64) that no life passes, or the time limit.

    Args:
        params: leaves ``[B]``.
        layouts: leaves ``[B, n]``.
    """
    needed = int(jnp.max(longest(params, layouts)))
    return max(64, 1 << (needed - 1).bit_length())


@jax.jit
@jax.vmap
def longest(params: Params, layout: Layout) -> Int[Array, ""]:
    """Slots ``[B]`` that the UAV's battery can pay for if every slot is as short as can be; leaves ``[B]``, ``[B, n]``."""
    least = jnp.full((1, layout.capacity.shape[0]), params.task_volume_range_bytes[0], jnp.float32)
    shortest = jnp.min(demand.slot_costs(params, layout, least).duration)
    base, _ = demand.flight_power(params)
    energy = params.uav_battery_j / jnp.maximum(base * shortest, 1e-3) + 2
    return jnp.minimum(energy, params.max_slots).astype(jnp.int32)


def beam_search(
    params: Params,
    layout: Layout,
    volumes: Num[Array, "H n"],
    width: int = WIDTH,
    at_most: Any = None,
    value_fn: ValueFn | None = None,
) -> Tour:
    """The longest life that the beam finds; clairvoyant in ``volumes``.

    Args:
        params: scenario parameters.
        layout: the devices.
        volumes: bytes, the tasks of every slot; ``H`` from :func:`horizon`.
        width: states kept per slot, static.
        at_most: a lifetime that is known not to be passed; the search begins there.
        value_fn: which of the states that are not provably lost are kept, e.g. the value that a critic has learned; by
            default those from which the way to the aim takes the least of what is left.
    """
    costs = demand.slot_costs(params, layout, volumes)
    covers = demand.coverage(params, layout)
    visit_share = demand.visit_shares(layout, covers)
    hover = demand.best_hover_point(covers, ~layout.has_power | ~layout.has_comms)
    calls_from = demand.best_hover_point(covers, ~layout.has_comms)
    round_m = _typical_round(layout, visit_share)
    problem = _Problem(params, layout, volumes, costs, visit_share, hover, calls_from, round_m, value_fn)
    aim = counting_bound(params, layout, costs)
    aim = aim if at_most is None else jnp.minimum(aim, at_most)

    def attempt(carry: tuple) -> tuple:
        aim, lifetime, actions = carry
        beam = _search(problem, aim, width)
        return aim - 1, jnp.maximum(beam.lifetime, lifetime), jnp.where(beam.lifetime > lifetime, beam.best, actions)

    nothing = jnp.full(volumes.shape[:1], -1, jnp.int32)
    # An attempt at one slot less is in vain once that much has been reached.
    _, lifetime, actions = jax.lax.while_loop(lambda carry: carry[1] < carry[0], attempt, (aim, jnp.int32(0), nothing))
    return Tour(lifetime=lifetime, actions=actions, aim=aim)


def counting_bound(params: Params, layout: Layout, costs: SlotCosts) -> Int[Array, ""]:
    """A lifetime that cannot be passed, in closed form: the visits needed must fit into the slots.

    A life of k slots means that k - 1 slots were survived and that the UAV could pay for k.
    """
    state = initial_state(params, layout)
    visit_share = demand.visit_shares(layout, demand.coverage(params, layout))
    slots = costs.work.shape[0]
    base, extra = demand.flight_power(params)
    first_hop = jnp.min(jnp.linalg.norm(layout.position, axis=-1)) / params.uav_speed_m_s
    paid = jnp.cumsum(base * jnp.min(costs.duration, axis=1)) + extra * first_hop

    def possible(life: Array) -> Array:
        need = demand.battery_demand(layout, costs, 0, life - 1)
        whole, _, hopeless = demand.battery_visits(layout, need, state.battery)
        fresh, _ = demand.age_visits(params, layout, state.age, life - 1)
        started = life - jnp.where(params.count_unfinished_slot, 1, 0)
        affordable = (started == 0) | (paid[started - 1] <= params.uav_battery_j * (1.0 + 1e-5))
        return (
            affordable
            & ~jnp.any(hopeless)
            & (jnp.sum(visit_share * jnp.maximum(whole, fresh)) <= life - 1 + 1e-3)
            & ~demand.overdue(params, layout, visit_share, state.age, life - 1)
        )

    lives = jnp.arange(1, slots + 1)
    best = jnp.max(jnp.where(jax.lax.map(possible, lives), lives, 1))
    return jnp.minimum(best, params.max_slots).astype(jnp.int32)


def _typical_round(layout: Layout, visit_share: Float[Array, " n"]) -> Float[Array, ""]:
    """Metres that one round through the devices without communication takes, guessed from nearest neighbours."""
    calls = ~layout.has_comms
    ground = jnp.linalg.norm(layout.position[:, None] - layout.position[None], axis=-1)
    apart = calls[:, None] & calls & ~jnp.eye(calls.shape[0], dtype=bool)
    nearest = jnp.min(jnp.where(apart, ground, jnp.inf), axis=1)
    return jnp.sum(jnp.where(calls & jnp.isfinite(nearest), nearest * visit_share, 0.0))


def _search(problem: _Problem, aim: Int[Array, ""], width: int) -> _Beam:
    """One attempt: slot after slot until the aim is reached or no state is left."""
    slots = problem.volumes.shape[0]
    start = initial_state(problem.params, problem.layout)
    beam = _Beam(
        slot=jnp.int32(0),
        states=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (width, *leaf.shape)), start),
        alive=jnp.arange(width) == 0,
        tours=jnp.full((width, slots), -1, jnp.int32),
        lifetime=jnp.int32(0),
        best=jnp.full((slots,), -1, jnp.int32),
    )
    going_on = lambda beam: (beam.lifetime < aim) & jnp.any(beam.alive) & (beam.slot < slots)  # noqa: E731
    return jax.lax.while_loop(going_on, partial(_advance, problem, aim, width), beam)


def _advance(problem: _Problem, aim: Int[Array, ""], width: int, beam: _Beam) -> _Beam:
    """Visit every device from every state; keep the most promising states that nothing dominates."""
    params, layout = problem.params, problem.layout
    n = layout.capacity.shape[0]
    after, outcome = visit_all(params, layout, beam.states, problem.volumes[beam.slot])

    lives = jnp.where(beam.alive[:, None], after.slot, 0).reshape(-1)
    longest = jnp.argmax(lives)
    ended = beam.tours[longest // n].at[beam.slot].set(longest % n)
    better = lives[longest] > beam.lifetime

    survives = (beam.alive[:, None] & (outcome.cause == Cause.NONE) & (after.slot < params.max_slots)).reshape(-1)
    after = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), after)
    promise = jnp.where(survives, _promise(problem, beam.slot + 1, aim, after), -jnp.inf)
    # Half as many again are held against each other, so that what falls out leaves no gap.
    promise, chosen = jax.lax.top_k(promise, min(width + width // 2, n * width))
    kept = jax.tree.map(lambda leaf: leaf[chosen], after)
    promise = jnp.where(_dominated(layout, kept, chosen % n, promise > -jnp.inf), -jnp.inf, promise)
    promise, best = jax.lax.top_k(promise, width)
    chosen = chosen[best]
    return _Beam(
        slot=beam.slot + 1,
        states=jax.tree.map(lambda leaf: leaf[best], kept),
        alive=promise > -jnp.inf,
        tours=beam.tours[chosen // n].at[:, beam.slot].set(chosen % n),
        lifetime=jnp.where(better, lives[longest], beam.lifetime),
        best=jnp.where(better, ended, beam.best),
    )


def visit_all(params: Params, layout: Layout, states: State, volumes: Num[Array, " n"]) -> tuple[State, Outcome]:
    """Every device visited from every state: leaves ``[W, ...]`` become ``[W, n, ...]``."""
    visit = jax.vmap(lambda state, action: transition(params, layout, state, action, volumes), (None, 0))
    return jax.vmap(visit, (0, None))(states, jnp.arange(volumes.shape[0]))


def _promise(problem: _Problem, slot: Array, aim: Array, states: State) -> Float[Array, " W"]:
    """Minus the share of the remaining slots, and of the UAV's spare energy, that the way to the aim takes.

    Minus infinity where the aim is provably out of reach: too many visits are needed, data would expire, the energy
    does not last.
    """
    params, layout, visit_share = problem.params, problem.layout, problem.visit_share
    left = aim - 1 - slot
    asked = demand.battery_demand(layout, problem.costs, slot, aim - 1)
    whole, part, hopeless = demand.battery_visits(layout, asked, states.battery)
    fresh, turns = demand.age_visits(params, layout, states.age, left)
    need, smooth = jnp.maximum(whole, fresh), jnp.maximum(part, turns - 1.0)

    base, extra = demand.flight_power(params)
    number = jnp.arange(problem.volumes.shape[0])
    paid = (number >= slot) & (number < aim - jnp.where(params.count_unfinished_slot, 1, 0))
    hovering = base * jnp.sum(jnp.where(paid, jnp.min(problem.costs.duration, axis=1), 0.0))
    spare = states.uav_energy * (1.0 + 1e-5) - hovering
    flights = extra * problem.round_m / params.uav_speed_m_s * left / jnp.maximum(slots_to_expiry(params), 1)

    lost = (
        jnp.any(hopeless, axis=-1)
        | (need @ visit_share > left + 1e-3)
        | demand.overdue(params, layout, visit_share, states.age, left)
        | (spare < 0.0)
    )
    if problem.value_fn is not None:
        return jnp.where(lost & (left >= 0), -jnp.inf, problem.value_fn(params, layout, states))
    # Devices that are served from one hover point share their visits.
    visits = jnp.sum(jnp.maximum(demand.max_by_hover_point(problem.hover, need + smooth), 0.0), axis=-1)
    pressure = 0.5 * visits / jnp.maximum(left, 1) + flights / jnp.maximum(spare, 1.0)
    pressure += jnp.where(_bunched(problem, states.age, left), _BUNCHED, 0.0)
    return jnp.where(lost & (left >= 0), -jnp.inf, -pressure)


def _bunched(problem: _Problem, age: Int[Array, "W n"], left: Array) -> Bool[Array, " W"]:
    """Whether the data cannot all be fetched in time, each from its usual hover point: likely, but no proof."""
    due = slots_to_expiry(problem.params) - age
    due = jnp.where(~problem.layout.has_comms & (due <= left), due, demand.NEVER)
    first = -demand.max_by_hover_point(problem.calls_from, -due)
    load = demand.load_by_due(first, jnp.ones(first.shape[-1]))
    return jnp.any((first < demand.NEVER) & (load > first), axis=-1)


def _dominated(layout: Layout, states: State, place: Int[Array, " W"], alive: Bool[Array, " W"]) -> Bool[Array, " W"]:
    """Whether another state at the same place is at least as good in every age, battery and in the UAV's energy.

    Of equal states the first one stays. Ages of connected and batteries of powered devices do not matter.
    """
    age = jnp.where(layout.has_comms, 0, states.age).astype(jnp.float32)
    battery = jnp.where(layout.has_power, 0.0, states.battery)
    worth = jnp.concatenate([-age, battery, states.uav_energy[:, None]], axis=1)
    columns, rank = worth.T, jnp.arange(place.shape[0])

    # One state against all others at a time, their quantities in rows: eight times as fast as all pairs at once.
    def against(other: Any, dominated: Array) -> Array:
        as_good, better = (place == place[other]) & alive[other], other < rank
        for quantity in range(worth.shape[1]):
            as_good &= columns[quantity] <= worth[other, quantity]
            better |= columns[quantity] < worth[other, quantity]
        return dominated | (as_good & better)

    return jax.lax.fori_loop(0, place.shape[0], against, jnp.zeros(place.shape, bool))

"""Exact optima of small instances by exhaustive search: the oracle that beam and bound are tested against.

Nothing is estimated and nothing of :mod:`uavmec_jax.planning.demand` is used. Every device is visited from every state, and
a state is dropped only if another one at the same hover point is at least as good in every age, every battery and the UAV's
energy: every continuation of the first then lasts at least as long from the second.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, Num

from uavmec_jax.env.dynamics import Cause, Outcome, State, initial_state
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning.beam import Tour, visit_all

MAX_STATES = 20_000
"""States kept per slot before an instance is refused as too large."""


def exact_tour(params: Params, layout: Layout, volumes: Num[np.ndarray, "H n"], max_states: int = MAX_STATES) -> Tour:
    """Return a tour with the longest lifetime of all tours; clairvoyant in ``volumes``.

    Args:
        params: scenario parameters.
        layout: the devices.
        volumes: bytes, the tasks of every slot.
        max_states: states kept per slot.

    Raises:
        ValueError: more than ``max_states`` states have to be kept: the instance is not small.
    """
    slots, n = volumes.shape
    states = jax.tree.map(lambda leaf: np.asarray(leaf)[None], initial_state(params, layout))
    tours = np.full((1, slots), -1, np.int32)
    lifetime, best_tour = 0, tours[0]
    for slot in range(min(slots, int(params.max_slots))):
        after, outcome = _visit_all(params, layout, states, volumes[slot])
        best = int(after.slot.argmax())
        if after.slot[best] > lifetime:
            lifetime, best_tour = int(after.slot[best]), tours[best // n].copy()
            best_tour[slot] = best % n
        alive = np.flatnonzero(outcome.cause == Cause.NONE)
        if not len(alive):
            break
        kept = _non_dominated(layout, jax.tree.map(lambda leaf, alive=alive: leaf[alive], after), alive % n)
        if len(kept) > max_states:
            raise ValueError(f"more than {max_states} states after {slot + 1} slots: too large to be solved exactly")
        chosen = alive[kept]
        states = jax.tree.map(lambda leaf, chosen=chosen: leaf[chosen], after)
        tours = tours[chosen // n]
        tours[:, slot] = chosen % n
    return Tour(lifetime=jnp.int32(lifetime), actions=jnp.asarray(best_tour), bound=jnp.int32(lifetime))


def _visit_all(params: Params, layout: Layout, states: State, volumes: Num[np.ndarray, " n"]) -> tuple[State, Outcome]:
    """Visit every device from each of ``S`` states; NumPy leaves ``[S * n, ...]``."""
    count, n = len(states.slot), len(volumes)
    padded = 1 << (count - 1).bit_length()  # few shapes, few compilations
    states = jax.tree.map(lambda leaf: np.concatenate([leaf, np.repeat(leaf[:1], padded - count, axis=0)]), states)
    visited = _jitted_visit_all(params, layout, states, jnp.asarray(volumes))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:count].reshape(count * n, *leaf.shape[2:]), visited)


_jitted_visit_all = jax.jit(visit_all)


def _non_dominated(layout: Layout, states: State, hover_point: Int[np.ndarray, " S"]) -> Int[np.ndarray, " kept"]:
    """Return the indices of the states that no other dominates; of equal states the first."""
    age = np.where(layout.has_comms, 0, -states.age)
    battery = np.where(layout.has_power, 0.0, states.battery)
    criteria = np.concatenate([age, battery, states.uav_energy], axis=1)
    kept: list[int] = []
    for hover in np.unique(hover_point):
        members = np.flatnonzero(hover_point == hover)
        # Whatever dominates a state precedes it in descending lexicographic order.
        members = members[np.lexsort(-criteria[members].T[::-1])]
        front = np.zeros((0, criteria.shape[1]))
        for member in members:
            if not np.any(np.all(front >= criteria[member], axis=1)):
                front = np.concatenate([front, criteria[member][None]])
                kept.append(int(member))
    return np.array(kept, int)

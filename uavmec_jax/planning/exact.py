"""The optimum of small instances, by exhausting every tour: the oracle that the beam and the bound are tested with.

Nothing is estimated here and nothing of :mod:`uavmec_jax.planning.demand` is used: every device is visited from every
state, and a state is dropped only if another one at the same place is at least as good in every age, every battery and in
the UAV's energy, for then every way on from the first is at least as long from the second.
"""

import jax
import jax.numpy as jnp
import numpy as np

from uavmec_jax.env.dynamics import Cause, Outcome, State, initial_state
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning.beam import Tour, visit_all

MOST_STATES = 20_000


def exact_tour(params: Params, layout: Layout, volumes: np.ndarray, most_states: int = MOST_STATES) -> Tour:
    """The longest life there is, with a tour that reaches it; clairvoyant in ``volumes [H, n]``.

    Raises:
        ValueError: more than ``most_states`` states have to be kept; the instance is not small.
    """
    slots, n = volumes.shape
    states = jax.tree.map(lambda leaf: np.asarray(leaf)[None], initial_state(params, layout))
    tours = np.full((1, slots), -1, np.int32)
    lifetime, best = 0, tours[0]
    for slot in range(min(slots, int(params.max_slots))):
        after, outcome = _visit_all(params, layout, states, volumes[slot])
        longest = int(after.slot.argmax())
        if after.slot[longest] > lifetime:
            lifetime, best = int(after.slot[longest]), tours[longest // n].copy()
            best[slot] = longest % n
        alive = np.flatnonzero(outcome.cause == Cause.NONE)
        if not len(alive):
            break
        kept = _undominated(layout, jax.tree.map(lambda leaf, alive=alive: leaf[alive], after), alive % n)
        if len(kept) > most_states:
            raise ValueError(f"more than {most_states} states after {slot + 1} slots: too large to be solved exactly")
        chosen = alive[kept]
        states = jax.tree.map(lambda leaf, chosen=chosen: leaf[chosen], after)
        tours = tours[chosen // n]
        tours[:, slot] = chosen % n
    return Tour(lifetime=np.int32(lifetime), actions=best, aim=np.int32(lifetime))


def _visit_all(params: Params, layout: Layout, states: State, volumes: np.ndarray) -> tuple[State, Outcome]:
    """Every device visited from every state; NumPy leaves ``[S * n, ...]``."""
    count, n = len(states.slot), len(volumes)
    padded = 1 << (count - 1).bit_length()  # few shapes, few compilations
    states = jax.tree.map(lambda leaf: np.concatenate([leaf, np.repeat(leaf[:1], padded - count, axis=0)]), states)
    found = _step(params, layout, states, jnp.asarray(volumes))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:count].reshape(count * n, *leaf.shape[2:]), found)


_step = jax.jit(visit_all)


def _undominated(layout: Layout, states: State, place: np.ndarray) -> np.ndarray:
    """Indices of states that no other dominates; of equal ones the first."""
    age = np.where(layout.has_comms, 0, -states.age)
    battery = np.where(layout.has_power, 0.0, states.battery)
    worth = np.concatenate([age, battery, states.uav_energy[:, None]], axis=1)
    kept: list[int] = []
    for here in np.unique(place):
        members = np.flatnonzero(place == here)
        # What dominates a state comes before it in lexicographic order.
        members = members[np.lexsort(-worth[members].T[::-1])]
        front = np.zeros((0, worth.shape[1]))
        for member in members:
            if not np.any(np.all(front >= worth[member], axis=1)):
                front = np.concatenate([front, worth[member][None]])
                kept.append(int(member))
    return np.array(kept, int)

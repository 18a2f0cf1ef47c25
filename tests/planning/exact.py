"""Exact optima of small instances by exhaustive search: the oracle that beam and bound are tested against.

Nothing is estimated and nothing of :mod:`uavmec_jax.planning.demand` is used. In every state every UAV flies to every place,
in all combinations, and a state is dropped only if another one with the same UAVs in the air, at the same places, is at least
as good in every age, every battery, every UAV's energy and every depot's packs: every continuation of the first then lasts at
least as long from the second. (A UAV with more energy is no worse off: instead of being grounded it stays where it is, and
in these instances an upload takes less time and energy than the work that it saves.)
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Num

from uavmec_jax.env.dynamics import Cause, Outcome, State, initial_state, transition
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning.beam import Tour

MAX_STATES = 20_000
"""States kept per slot before an instance is refused as too large."""


def exact_tour(params: Params, layout: Layout, volumes: Num[np.ndarray, "H n"], max_states: int = MAX_STATES) -> Tour:
    """Return a tour with the longest lifetime of all tours; clairvoyant in ``volumes``.

    Args:
        params: scenario parameters.
        layout: the devices, the UAVs and the depots.
        volumes: bytes, the tasks of every slot.
        max_states: states kept per slot.

    Raises:
        ValueError: more than ``max_states`` states have to be kept: the instance is not small.
    """
    slots, actions = len(volumes), joint_actions(layout)
    count = len(actions)
    states = jax.tree.map(lambda leaf: np.asarray(leaf)[None], initial_state(params, layout))
    tours = np.full((1, slots, *layout.action_shape), -1, np.int32)
    lifetime, best_tour = 0, tours[0]
    for slot in range(min(slots, int(params.max_slots))):
        after, outcome = _play_all(params, layout, states, actions, volumes[slot])
        best = int(after.slot.argmax())
        if after.slot[best] > lifetime:
            lifetime, best_tour = int(after.slot[best]), tours[best // count].copy()
            best_tour[slot] = actions[best % count]
        alive = np.flatnonzero(outcome.cause == Cause.NONE)
        if not len(alive):
            break
        kept = _non_dominated(layout, jax.tree.map(lambda leaf, alive=alive: leaf[alive], after))
        if len(kept) > max_states:
            raise ValueError(f"more than {max_states} states after {slot + 1} slots: too large to be solved exactly")
        chosen = alive[kept]
        states = jax.tree.map(lambda leaf, chosen=chosen: leaf[chosen], after)
        tours = tours[chosen // count]
        tours[:, slot] = actions[chosen % count]
    return Tour(lifetime=jnp.int32(lifetime), actions=jnp.asarray(best_tour), bound=jnp.int32(lifetime))


def joint_actions(layout: Layout) -> Int[np.ndarray, "A *K"]:
    """Return all actions of the fleet, ``(n + D) ** K``; scalars for one UAV."""
    joint = itertools.product(range(layout.n_places), repeat=layout.n_uavs)
    return np.array(list(joint), np.int32).reshape(-1, *layout.action_shape)


def _play_all(
    params: Params, layout: Layout, states: State, actions: Int[np.ndarray, "A *K"], volumes: Num[np.ndarray, " n"]
) -> tuple[State, Outcome]:
    """Take every action in each of ``S`` states; NumPy leaves ``[S * A, ...]``."""
    count = len(states.slot)
    padded = 1 << (count - 1).bit_length()  # few shapes, few compilations
    states = jax.tree.map(lambda leaf: np.concatenate([leaf, np.repeat(leaf[:1], padded - count, axis=0)]), states)
    played = _jitted_play_all(params, layout, states, actions, jnp.asarray(volumes))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:count].reshape(count * len(actions), *leaf.shape[2:]), played)


@jax.jit
def _jitted_play_all(
    params: Params, layout: Layout, states: State, actions: Int[Array, "A *K"], volumes: Num[Array, " n"]
) -> tuple[State, Outcome]:
    """Take every action in every state; leaves ``[S, A, ...]``."""
    play = jax.vmap(lambda state, action: transition(params, layout, state, action, volumes), (None, 0))
    return jax.vmap(play, (0, None))(states, actions)


def _non_dominated(layout: Layout, states: State) -> Int[np.ndarray, " kept"]:
    """Return the indices of the states that no other dominates; of equal states the first.

    Ages of connected and batteries of powered devices do not count, nor does where a grounded UAV is, and with how much
    energy.
    """
    age = np.where(layout.has_comms, 0, -states.age)
    battery = np.where(layout.has_power, 0.0, states.battery)
    energy = np.where(states.grounded, 0.0, states.uav_energy)
    packs = np.where(np.isinf(states.packs), 0.0, states.packs)  # (all have infinitely many or none has)
    criteria = np.concatenate([age, battery, energy, packs], axis=1)
    place = np.where(states.grounded[..., None], np.nan, states.uav_position).reshape(len(age), -1)
    _, group = np.unique(place, axis=0, return_inverse=True, equal_nan=True)
    group = group.reshape(-1)  # NumPy 2.0 keeps an axis
    # Nothing dominates the first in this order.
    order = np.argsort(-np.sum(criteria / np.maximum(np.abs(criteria).max(axis=0), 1e-9), axis=1), kind="stable")
    kept: list[int] = []
    for number in range(group.max() + 1):
        left = order[group[order] == number]
        while len(left):
            kept.append(int(left[0]))
            left = left[~np.all(criteria[left] <= criteria[left[0]], axis=1)]
    return np.array(kept, int)

"""The rollout planner: one step of policy improvement by Monte Carlo rollouts (Tesauro and Galperin 1996).

It tries every place as the next target and simulates how the episode continues under a base policy; a fleet decides one UAV
at a time.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Key, PRNGKeyArray

from uavmec_jax.env.checks import check_range
from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode, Policy, rollout_from
from uavmec_jax.planning.fleet_deadlines import earliest_deadline
from uavmec_jax.planning.fleet_demand import is_alone

SAMPLES = 4
"""Futures simulated per candidate by default. 16 futures take four times the work for lifetimes that are 0.05 % longer."""

_PREFERENCE = 1e-3
"""Slots by which a candidate must exceed the base policy's choice."""

_A = TypeVar("_A", Array, np.ndarray)


def rollout_planner(base: Policy = earliest_deadline, samples: int = SAMPLES) -> Policy:
    """Return a policy that simulates every candidate visit to the end and takes the one with the longest mean lifetime.

    In a fleet, one UAV improves its part of the base policy's action at a time, in the order of their numbers, while the
    later ones keep to the base policy (Bertsekas 2019): ``K (n + D)`` candidates instead of ``(n + D)^K``. With
    ``end = "horizon"`` the value of a future is the time in service, not the lifetime.

    The planner is not clairvoyant: the task volumes, those of the present slot included, are drawn from its own key and are
    the same for every candidate.

    Args:
        base: decides in the slots after the candidate visit.
        samples: futures simulated per candidate.

    Raises:
        ArgumentError: there are no futures; one line.
        ValueError: (when called) no key was given.
    """
    check_range("samples", samples, ge=1, whole=True)

    def policy(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
        if key is None:
            raise ValueError("the rollout planner needs a key")
        choice = base(params, layout, state, key)
        futures = jax.random.split(key, samples)

        def improve(uav: int | Int[Array, ""], action: Int[Array, "*K"]) -> Int[Array, "*K"]:
            candidates = candidates_of(layout, action, uav)
            episodes = try_candidates(base, params, layout, state, futures, candidates)
            mine = action if layout.n_uavs == 1 else action[uav]
            value = prefer(mine, jnp.mean(values_of(params, layout, episodes), axis=1))
            best = jnp.argmax(jnp.where(real_places(layout), value, -jnp.inf))
            return candidates[best].astype(jnp.int32)

        if layout.n_uavs == 1:
            return improve(0, choice)
        return jax.lax.fori_loop(0, layout.n_uavs, improve, choice)

    return policy


def candidates_of(layout: Layout, action: Int[Array, "*K"], uav: int | Int[Array, ""]) -> Int[Array, "n_places *K"]:
    """Return the actions in which one UAV flies to each of the places and the others keep to ``action``."""
    places = jnp.arange(layout.n_places)
    if layout.n_uavs == 1:
        return places
    return jnp.where(jnp.arange(layout.n_uavs) == uav, places[:, None], action)


def real_places(layout: Layout) -> Bool[Array, " n_places"]:
    """Return which places are devices or depots and not padding."""
    devices = jnp.ones(layout.n_devices, bool) if layout.present is None else layout.present
    return devices if layout.depots is None else jnp.concatenate([devices, layout.depots.pads >= 1])


def values_of(params: Params, layout: Layout, episodes: Episode) -> Float[Array, "*batch"]:
    """Return what the planner makes as large as it can: the lifetimes, or with a horizon, the time in service.

    Both are in slots, the time in service in slots of the longest kind.

    For fleets the last slot counts up to the first failure in it: candidates that seem equal in whole slots are told apart.
    """
    if params.end == "horizon":
        return jnp.asarray(episodes.service_s) / params.slot_cap_s
    lifetimes = episodes.length.astype(jnp.float32)
    return lifetimes if is_alone(layout) else lifetimes + (episodes.lasted - 1.0)


def try_candidates(
    policy: Policy,
    params: Params,
    layout: Layout,
    state: State,
    futures: Key[Array, " S"],
    candidates: Int[Array, "C *K"],
) -> Episode:
    """Take every candidate action next in every future and follow the policy from then on; leaves ``[C, S, ...]``."""

    def episode(action: Int[Array, "*K"], future: PRNGKeyArray) -> Episode:
        def act_first(params: Params, layout: Layout, later: State, key: PRNGKeyArray | None = None) -> Array:
            return jnp.where(later.slot == state.slot, action, policy(params, layout, later, key))

        return rollout_from(act_first, params, layout, state, future)

    return jax.vmap(jax.vmap(episode, (None, 0)), (0, None))(candidates, futures)


def prefer(choice: Int[ArrayLike, ""], value: Float[_A, " n"]) -> Float[_A, " n"]:
    """Return the values of the candidates with a small bonus for the policy's own choice, which thus wins near ties."""
    return value + _PREFERENCE * (np.arange(value.shape[0]) == choice)

"""Plan for many scenarios at once: split over the local devices, on each one after the other or in batches."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Key

from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode, Policy, rollout, rollout_with_actions, rollouts, tour_policy, volume_table
from uavmec_jax.planning.beam import ValueFn, beam_search
from uavmec_jax.planning.bound import upper_bounds
from uavmec_jax.planning.deadlines import earliest_deadline
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.rollout_planner import rollout_planner

_CPU_BATCH = 64
"""Scenarios that a CPU core plays a policy on at once: enough for its matrix products, few enough for its cache."""

_ACCELERATOR_BATCH = 256
"""Scenarios planned for at once on an accelerator. A CPU core takes one at a time and keeps it in its cache."""


@partial(jax.jit, static_argnames=("slots", "width", "value_fn"))
def beam_episodes(
    params: Params,
    layouts: Layout,
    keys: Key[Array, " B"],
    *,
    slots: int,
    width: int,
    value_fn: ValueFn | None = None,
) -> tuple[Any, Episode]:
    """The beam's tour for each of ``B`` scenarios, and the episode that it makes; clairvoyant.

    Args:
        params: leaves ``[B]``.
        layouts: leaves ``[B, n]``.
        keys: volume draws.
        slots: from :func:`uavmec_jax.planning.beam.horizon`.
        width: states kept per slot.
        value_fn: see :func:`beam_search`.
    """

    def one(params: Params, layout: Layout, key: Key[Array, ""]) -> tuple[Array, Episode]:
        volumes = volume_table(params, layout.capacity.shape[0], key, slots)
        plan = beam_search(params, layout, volumes, width, value_fn=value_fn)
        return plan.actions, rollout(tour_policy(plan.actions), params, layout, key)

    return spread(one, params, layouts, keys)


@partial(jax.jit, static_argnames=("slots", "samples", "base"))
def rollout_planner_episodes(
    params: Params,
    layouts: Layout,
    keys: Key[Array, " B"],
    *,
    slots: int,
    samples: int,
    base: Policy = earliest_deadline,
) -> tuple[Any, Episode]:
    """The rollout planner's tour for each scenario, and its episode; see :func:`rollout_planner` and :func:`beam_episodes`."""
    return spread(partial(rollout_with_actions, rollout_planner(base, samples), slots=slots), params, layouts, keys)


@partial(jax.jit, static_argnames="policy")
def policy_episodes(policy: Policy, params: Params, layouts: Layout, keys: Key[Array, "B D"]) -> Episode:
    """Episodes ``[B, D]`` of any policy, ``B`` scenarios with ``D`` volume draws each, a batch of them at a time."""
    one = lambda params, layout, keys: rollouts(policy, params, layout, keys)  # noqa: E731
    return spread(one, params, layouts, keys, batch=_CPU_BATCH)


@partial(jax.jit, static_argnames="names")
def heuristic_episodes(names: tuple[str, ...], params: Params, layouts: Layout, keys: Key[Array, "B D"]) -> Episode:
    """Episodes ``[K, B, D]`` of ``K`` heuristics: one after the other through one compiled slot."""

    def play(index: Array) -> Episode:
        def policy(*arguments: Any) -> Array:
            return jax.lax.switch(index, [HEURISTICS[name] for name in names], *arguments)

        return jax.vmap(partial(rollouts, policy))(params, layouts, keys)

    return jax.lax.map(play, jnp.arange(len(names)))


def bound_scenarios(
    params: Params, layouts: Layout, keys: Key[Array, " B"], at_least: np.ndarray, *, slots: int
) -> np.ndarray:
    """Upper bounds ``[B]`` int32 of ``B`` scenarios; ``at_least [B]`` are lifetimes that were reached."""
    return upper_bounds(params, layouts, _tables(params, layouts, keys, slots), at_least)


@partial(jax.jit, static_argnames="slots")
def _tables(params: Params, layouts: Layout, keys: Key[Array, " B"], slots: int) -> Array:
    n = layouts.capacity.shape[1]
    return jax.vmap(lambda params, key: volume_table(params, n, key, slots))(params, keys)


def spread(function: Callable, *arguments: Any, batch: int | None = None) -> Any:
    """``vmap(function)(*arguments)`` over the leading axis, split over the local devices; call under ``jit``.

    A CPU takes ``batch`` entries at a time, one by default.
    """
    devices = jax.local_devices()
    count = jax.tree.leaves(arguments)[0].shape[0]
    missing = -count % len(devices)
    if missing:
        arguments = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf[:1].repeat(missing, 0)]), arguments)
    mesh, split = Mesh(devices, ("scenarios",)), PartitionSpec("scenarios")
    batch = batch if devices[0].platform == "cpu" else _ACCELERATOR_BATCH
    in_turn = lambda *shard: jax.lax.map(lambda one: function(*one), shard, batch_size=batch)  # noqa: E731
    # check_vma: the loops end when each device's own scenarios end, which the checker has no type for.
    mapped = jax.shard_map(in_turn, mesh=mesh, in_specs=(split,) * len(arguments), out_specs=split, check_vma=False)
    return jax.tree.map(lambda leaf: leaf[:count], mapped(*arguments))

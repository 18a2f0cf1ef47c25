"""Planning for many scenarios at once: they are split over the local devices, and on each planned in batches or in turn."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Int, Key, Num

from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode, Policy, rollout, rollout_with_actions, rollouts, tour_policy, volume_table
from uavmec_jax.planning.beam import beam_search
from uavmec_jax.planning.beam_score import ValueFn
from uavmec_jax.planning.bound import upper_bounds
from uavmec_jax.planning.fleet_deadlines import earliest_deadline
from uavmec_jax.planning.heuristics import FLEET_HEURISTICS
from uavmec_jax.planning.rollout_planner import rollout_planner

_CPU_BATCH = 64
"""Scenarios in which a CPU core runs a policy at once: enough for its matrix products, few enough for its cache."""

_ACCELERATOR_BATCH = 256
"""Scenarios planned for at once on an accelerator. (A CPU core takes one at a time and keeps it in its cache.)"""


@partial(jax.jit, static_argnames=("slots", "width", "value_fn"))
def beam_episodes(
    params: Params,
    layouts: Layout,
    keys: Key[Array, " B"],
    *,
    slots: int,
    width: int,
    value_fn: ValueFn | None = None,
) -> tuple[Int[Array, "B {slots} *K"], Episode]:
    """Return the tour of the clairvoyant beam for each of ``B`` scenarios, ``[B, slots]``, and its episode.

    The tours of a fleet are ``[B, slots, K]``.

    Args:
        params: leaves ``[B]``.
        layouts: leaves ``[B, n]``.
        keys: volume draws.
        slots: from :func:`uavmec_jax.planning.fleet_demand.planned_slots`.
        width: states kept per slot.
        value_fn: see :func:`beam_search`.
    """

    def search(params: Params, layout: Layout, key: Key[Array, ""]) -> tuple[Int[Array, "H *K"], Episode]:
        volumes = volume_table(params, layout.capacity.shape[0], key, slots)
        tour = beam_search(params, layout, volumes, width, value_fn=value_fn)
        return tour.actions, rollout(tour_policy(tour.actions), params, layout, key)

    return spread(search, params, layouts, keys)


@partial(jax.jit, static_argnames=("slots", "samples", "base"))
def rollout_planner_episodes(
    params: Params,
    layouts: Layout,
    keys: Key[Array, " B"],
    *,
    slots: int,
    samples: int,
    base: Policy = earliest_deadline,
) -> tuple[Int[Array, "B {slots} *K"], Episode]:
    """Return the rollout planner's tour for each of ``B`` scenarios, ``[B, slots]``, and its episode.

    The tours of a fleet are ``[B, slots, K]``.

    Args:
        params: leaves ``[B]``.
        layouts: leaves ``[B, n]``.
        keys: volume draws.
        slots: length of the tours.
        samples: futures simulated per candidate.
        base: the planner's base policy, see :func:`rollout_planner`.
    """
    return spread(partial(rollout_with_actions, rollout_planner(base, samples), slots=slots), params, layouts, keys)


@partial(jax.jit, static_argnames="policy")
def policy_episodes(policy: Policy, params: Params, layouts: Layout, keys: Key[Array, "B D"]) -> Episode:
    """Run a policy in ``B`` scenarios with ``D`` volume draws each; leaves ``[B, D, ...]``."""
    episodes = lambda params, layout, keys: rollouts(policy, params, layout, keys)  # noqa: E731
    return spread(episodes, params, layouts, keys, batch=_CPU_BATCH)


@partial(jax.jit, static_argnames="names")
def heuristic_episodes(names: tuple[str, ...], params: Params, layouts: Layout, keys: Key[Array, "B D"]) -> Episode:
    """Run ``K`` heuristics in ``B`` scenarios with ``D`` volume draws each; leaves ``[K, B, D, ...]``.

    The heuristics run one after the other through the same compiled slot.
    """

    def episodes(index: Int[Array, ""]) -> Episode:
        def policy(*arguments: Any) -> Array:
            return jax.lax.switch(index, [FLEET_HEURISTICS[name] for name in names], *arguments)

        return jax.vmap(partial(rollouts, policy))(params, layouts, keys)

    return jax.lax.map(episodes, jnp.arange(len(names)))


def bound_scenarios(
    params: Params, layouts: Layout, keys: Key[Array, " B"], reached: Num[np.ndarray, " B"], *, slots: int
) -> Int[np.ndarray, " B"]:
    """Return the upper bounds of ``B`` scenarios; see :func:`uavmec_jax.planning.bound.upper_bound`.

    Args:
        params: leaves ``[B]``.
        layouts: leaves ``[B, n]``.
        keys: volume draws.
        reached: lifetimes that some policy reaches.
        slots: from :func:`uavmec_jax.planning.fleet_demand.planned_slots`.
    """
    return upper_bounds(params, layouts, _volume_tables(params, layouts, keys, slots), reached)


@partial(jax.jit, static_argnames="slots")
def _volume_tables(params: Params, layouts: Layout, keys: Key[Array, " B"], slots: int) -> Num[Array, "B H n"]:
    """Return the task volumes in bytes of each scenario's draw."""
    n = layouts.capacity.shape[1]
    return jax.vmap(lambda params, key: volume_table(params, n, key, slots))(params, keys)


def spread(function: Callable, *arguments: Any, batch: int | None = None) -> Any:
    """Map a function over the leading axis of its arguments, as ``jax.vmap`` does, split over the local devices.

    Call it under ``jit``. Arguments whose length is no multiple of the number of devices are padded.

    Args:
        function: of one entry of each argument.
        arguments: pytrees, leaves ``[B, ...]``.
        batch: entries that a CPU takes at once, one by default; accelerators take :data:`_ACCELERATOR_BATCH`.
    """
    devices = jax.local_devices()
    count = jax.tree.leaves(arguments)[0].shape[0]
    missing = -count % len(devices)
    if missing:
        arguments = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf[:1].repeat(missing, 0)]), arguments)
    mesh, split = Mesh(devices, ("scenarios",)), PartitionSpec("scenarios")
    batch = batch if devices[0].platform == "cpu" else _ACCELERATOR_BATCH
    on_device = lambda *shard: jax.lax.map(lambda entry: function(*entry), shard, batch_size=batch)  # noqa: E731
    # check_vma is off: the loops end when each device's own scenarios end, which the checker has no type for.
    mapped = jax.shard_map(on_device, mesh=mesh, in_specs=(split,) * len(arguments), out_specs=split, check_vma=False)
    return jax.tree.map(lambda leaf: leaf[:count], mapped(*arguments))

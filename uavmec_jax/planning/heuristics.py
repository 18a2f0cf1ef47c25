"""Heuristic policies: the baselines that every table shows beside the learned policies.

Each has the signature of a policy, ``policy(params, layout, state, key=None) -> action`` with an int32, a place in
``[0, n + D)``, one per UAV.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from uavmec_jax.env.dynamics import State, slots_to_expiry
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy
from uavmec_jax.planning import demand
from uavmec_jax.planning.fleet_deadlines import earliest_deadline, split_deadline
from uavmec_jax.planning.fleet_rules import for_fleets
from uavmec_jax.planning.shortest_tour import shortest_tour


def stay_put(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Hover above the first device for the whole episode; the UAVs of a fleet hover above the first ones."""
    return jnp.argmax(jnp.minimum(state.age, 0)).astype(jnp.int32)


def random(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Visit a device drawn uniformly.

    Raises:
        ValueError: no key was given.
    """
    if key is None:
        raise ValueError("the random policy needs a key")
    return nth_device(layout, lambda count: jax.random.randint(key, (), 0, count, jnp.int32))


def round_robin(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Visit the devices in the order of their indices, over and over."""
    return nth_device(layout, lambda count: state.slot % count)


def nth_device(layout: Layout, number: Callable[[int | Int[Array, ""]], Int[Array, ""]]) -> Int[Array, ""]:
    """Return the index of device ``number(count)`` among the ``count`` devices; padding is not counted."""
    if layout.present is None:
        return number(layout.capacity.shape[0])
    chosen = number(jnp.sum(layout.present))
    return jnp.argmax(jnp.cumsum(layout.present) > chosen).astype(jnp.int32)


def oldest_first(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Visit the device whose data are oldest; ties go to the lowest index."""
    return jnp.argmax(state.age).astype(jnp.int32)


def lowest_battery(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Visit the device with the lowest battery fraction; ties go to the lowest index."""
    return jnp.argmin(state.battery / layout.capacity).astype(jnp.int32)


def shortest_life(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Visit the device that is expected to fail first if no device is served from now on.

    A battery lasts for ``battery / (standby + expected work)`` slots, data last until they expire.
    """
    drain = demand.idle_drain(layout, demand.mean_slot(params, layout))
    battery = jnp.where(layout.has_power, jnp.inf, state.battery / jnp.maximum(drain, 1e-6))
    data = jnp.where(layout.has_comms, jnp.inf, slots_to_expiry(params) - state.age)
    return jnp.argmin(jnp.minimum(battery, data)).astype(jnp.int32)


HEURISTICS: Mapping[str, Policy] = MappingProxyType(
    {
        "stay-put": for_fleets(stay_put),
        "random": for_fleets(random),
        "round-robin": for_fleets(round_robin),
        "oldest-first": for_fleets(oldest_first),
        "lowest-battery": for_fleets(lowest_battery),
        "shortest-life": for_fleets(shortest_life),
        "shortest-tour": for_fleets(shortest_tour),
        "earliest-deadline": earliest_deadline,
    }
)
"""Heuristics by name, for any number of UAVs. None knows the task volumes of the slot that it decides about."""

FLEET_HEURISTICS: Mapping[str, Policy] = MappingProxyType({**HEURISTICS, "split-deadline": split_deadline})
"""All heuristics by name: those of :data:`HEURISTICS`, and those that are the same as one of them for one UAV."""

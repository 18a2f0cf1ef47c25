"""Policies that learn nothing: the baselines every table shows beside the learned ones.

Each has the common shape ``policy(params, layout, state, key=None) -> action`` (int32 in ``[0, n)``).
"""

from collections.abc import Mapping
from types import MappingProxyType

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from uavmec_jax.world.layout import Layout
from uavmec_jax.world.params import Params
from uavmec_jax.world.physics import State
from uavmec_jax.world.rollout import Policy


def stay_put(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Hover over the first device for good."""
    return jnp.zeros((), jnp.int32)


def random(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Visit any device, uniformly.

    Raises:
        ValueError: no key was given.
    """
    if key is None:
        raise ValueError("the random policy needs a key")
    return jax.random.randint(key, (), 0, layout.capacity.shape[0], jnp.int32)


def round_robin(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Visit the devices in the order of their numbers, over and over."""
    return state.slot % layout.capacity.shape[0]


def oldest_first(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Visit the device whose data are oldest; ties go to the lowest number."""
    return jnp.argmax(state.age).astype(jnp.int32)


HEURISTICS: Mapping[str, Policy] = MappingProxyType(
    {"stay-put": stay_put, "random": random, "round-robin": round_robin, "oldest-first": oldest_first}
)
"""The baselines by name."""

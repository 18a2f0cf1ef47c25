"""Play whole episodes: every policy, learned or not, is judged by this one loop."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Key, PRNGKeyArray

from uavmec_jax.world.environment import draw_volumes
from uavmec_jax.world.layout import Layout
from uavmec_jax.world.params import Params
from uavmec_jax.world.physics import Cause, Outcome, State, initial_state, transition

Policy = Callable[..., Array]
"""``policy(params, layout, state, key=None) -> action``: int32 in ``[0, n)``; pure, jit- and vmap-able."""

_POLICY_STREAM = 2**32 - 1
"""``fold_in`` number of the policy's own randomness; the slots' volumes use their own numbers, from 0."""


@struct.dataclass
class Episode:
    """How one episode went.

    Attributes:
        length: int32, the lifetime in slots (paper: episode length).
        cause: int32, a :class:`Cause`; ``NONE`` if the time limit ended it.
        failed: ``[n]`` bool, devices that failed in the last slot.
        first_failure: ``[n]`` f32, share of each device in the first failure; sums to 1 unless no device failed.
    """

    length: Any
    cause: Any
    failed: Any
    first_failure: Any


def slot_volumes(params: Params, n_devices: int, key: PRNGKeyArray, slot: Any) -> Array:
    """Task volumes ``[n]`` in bytes of slot number ``slot`` in the volume draw that ``key`` stands for."""
    return draw_volumes(params, jax.random.uniform(jax.random.fold_in(key, slot), (n_devices,)))


def rollout(policy: Policy, params: Params, layout: Layout, key: PRNGKeyArray) -> Episode:
    """Play one episode.

    Args:
        policy: whom to ask for the next device.
        params: scenario parameters.
        layout: the devices.
        key: the volume draw. Two policies given the same key meet the same volumes, slot by slot. The policy's own
            randomness comes from another stream of the key.
    """
    n = layout.capacity.shape[0]
    policy_key = jax.random.fold_in(key, _POLICY_STREAM)

    def alive(carry: tuple[State, Outcome]) -> Array:
        state, outcome = carry
        return (outcome.cause == Cause.NONE) & (state.slot < params.max_slots)

    def play_slot(carry: tuple[State, Outcome]) -> tuple[State, Outcome]:
        state, _ = carry
        action = policy(params, layout, state, jax.random.fold_in(policy_key, state.slot))
        return transition(params, layout, state, action, slot_volumes(params, n, key, state.slot))

    nothing = Outcome(
        cause=jnp.int32(Cause.NONE),
        failed=jnp.zeros(n, bool),
        served=jnp.zeros(n, bool),
        duration=jnp.float32(0),
        first_failure=jnp.zeros(n, jnp.float32),
    )
    state, outcome = jax.lax.while_loop(alive, play_slot, (initial_state(params, layout), nothing))
    return Episode(length=state.slot, cause=outcome.cause, failed=outcome.failed, first_failure=outcome.first_failure)


def rollouts(policy: Policy, params: Params, layout: Layout, keys: Key[Array, " D"]) -> Episode:
    """Play one episode per volume draw; ``keys`` is ``[D]`` and every field of the result gains a leading ``D``."""
    return jax.vmap(lambda key: rollout(policy, params, layout, key))(keys)

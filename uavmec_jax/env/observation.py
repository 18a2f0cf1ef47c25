"""The paper's observation: battery fractions and data ages."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params


def observe(params: Params, layout: Layout, state: State) -> Float[Array, "*batch obs_size"]:
    """Return the paper's observation, ``[..., 2n]`` f32.

    Args:
        params: not used; every ``observation_fn`` has these arguments.
        layout: the devices.
        state: one state, or a batch of states of these devices.

    Returns:
        n battery fractions in [0, 1], then n data ages in slots.
    """
    del params
    return jnp.concatenate([state.battery / layout.capacity, state.age.astype(jnp.float32)], axis=-1)

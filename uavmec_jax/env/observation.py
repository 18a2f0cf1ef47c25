"""The paper's observation: battery fractions and data ages."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params


def observe(layout: Layout, state: State) -> Float[Array, "*b two_n"]:
    """The paper's observation, ``[..., 2n]`` f32: n battery fractions in [0, 1], then n data ages as plain counts."""
    return jnp.concatenate([state.battery / layout.capacity, state.age.astype(jnp.float32)], axis=-1)


def observe_as_paper(params: Params, layout: Layout, state: State) -> Float[Array, "*b two_n"]:
    """:func:`observe`, called as every way to see is."""
    return observe(layout, state)

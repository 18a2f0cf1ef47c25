"""Sums that do not depend on the order of their terms."""

import jax.numpy as jnp
from jaxtyping import Array, Float

_STEP = 2.0**-16
_LARGEST = 500.0
"""64 terms of this size fit into 32 bits."""


def order_independent_sum(x: Float[Array, "*s"], axis: int = -1) -> Float[Array, "*t"]:
    """The sum over an axis of at most 64 terms, the same to the bit in whatever order they come.

    It is taken in fixed point: terms are rounded to steps of 2**-16, and cut where they pass +-500.
    """
    steps = jnp.round(jnp.clip(x, -_LARGEST, _LARGEST) / _STEP).astype(jnp.int32)
    return jnp.sum(steps, axis=axis).astype(jnp.float32) * _STEP

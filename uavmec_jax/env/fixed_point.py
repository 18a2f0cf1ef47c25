"""Sums that do not depend on the order of their terms."""

import jax.numpy as jnp
from jaxtyping import Array, Float

_STEP = 2.0**-16
_LARGEST = 500.0
"""64 terms of this size fit into 32 bits."""


def order_independent_sum(x: Float[Array, "*shape"], axis: int = -1) -> Float[Array, "*reduced"]:
    """Sum at most 64 terms along an axis; the result has the same bits for every order of the terms.

    The sum is taken in fixed point: terms are rounded to multiples of 2**-16 and clipped to +-500.
    """
    steps = jnp.round(jnp.clip(x, -_LARGEST, _LARGEST) / _STEP).astype(jnp.int32)
    return jnp.sum(steps, axis=axis).astype(jnp.float32) * _STEP

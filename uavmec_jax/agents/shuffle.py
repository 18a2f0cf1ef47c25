"""Random orders of the samples of a rollout."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray


def permutation(key: PRNGKeyArray, size: int) -> Int[Array, " size"]:
    """Draw a random order: the ranks of random words.

    Two equal words, which occur once in about 2,000 orders of 2,048 elements, keep their order.
    """
    return jax.lax.sort_key_val(jax.random.bits(key, (size,)), jnp.arange(size))[1]

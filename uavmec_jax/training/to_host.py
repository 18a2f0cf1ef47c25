"""Pytrees between processes: NumPy arrays, and JAX's typed keys as their data, since the keys cannot be serialised."""

from typing import Any

import jax
import numpy as np
from flax import struct


@struct.dataclass
class KeyData:
    """Typed keys as data.

    Attributes:
        data: the data, ``[..., words]``.
        implementation: name of the random number generator.
    """

    data: Any
    implementation: str = struct.field(pytree_node=False)


def to_host(tree: Any) -> Any:
    """Return a pytree with NumPy leaves, and :class:`KeyData` in place of typed keys; any process can read it."""

    def convert(leaf: Any) -> Any:
        if isinstance(leaf, jax.Array) and jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return KeyData(np.asarray(jax.random.key_data(leaf)), str(jax.random.key_impl(leaf)))
        return np.asarray(leaf)

    return jax.tree.map(convert, tree)


def from_host(tree: Any) -> Any:
    """Return the pytree that :func:`to_host` was given."""

    def convert(leaf: Any) -> Any:
        if isinstance(leaf, KeyData):
            return jax.random.wrap_key_data(leaf.data, impl=leaf.implementation)
        return jax.numpy.asarray(leaf)

    return jax.tree.map(convert, tree, is_leaf=lambda leaf: isinstance(leaf, KeyData))

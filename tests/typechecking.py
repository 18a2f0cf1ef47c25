"""The run-time type checker of the tests: beartype, and the fields of every pytree that crosses a function boundary.

A pytree's constructor is not checked: JAX calls it with shapes and sentinels too.
"""

import dataclasses
import functools
from typing import Any, get_args

import jax
import numpy as np
from beartype import BeartypeConf, beartype
from beartype.door import is_bearable
from jaxtyping import AbstractArray, TypeCheckError, jaxtyped

_CONF = BeartypeConf(is_pep484_tower=True)  # an int is accepted where a float is asked for
_LEAVES = (jax.Array, np.ndarray, np.generic, int, float)


def checked(function):
    """Check arguments and result of a function; jaxtyping calls it with the signature of each function of the package."""
    check = beartype(conf=_CONF)(function)

    @functools.wraps(function)
    def check_call(*arguments, **named):
        if function.__name__ == "__init__" and _is_pytree(type(arguments[0])):
            return
        check(*arguments, **named)
        for value in (*arguments, *named.values()):
            check_fields(value)

    return check_call


def check_fields(tree: Any) -> None:
    """Check the fields of a pytree of the package, and of those inside it: types, and shapes that fit together.

    Raises:
        TypeCheckError: a leaf has another dtype or shape than its field says.
    """
    if not _is_pytree(type(tree)):
        return
    with jaxtyped("context"):
        for field in dataclasses.fields(tree):
            value = getattr(tree, field.name)
            if isinstance(value, _LEAVES) and not is_bearable(value, _hint(field.type, type(value)), conf=_CONF):
                found = f"{value.dtype}{list(value.shape)}" if hasattr(value, "shape") else repr(value)
                raise TypeCheckError(f"{type(tree).__name__}.{field.name} is {found}; it should be {field.type}")
    for field in dataclasses.fields(tree):
        check_fields(getattr(tree, field.name))


def _is_pytree(kind: type) -> bool:
    return hasattr(kind, "_flax_dataclass") and kind.__module__.startswith("uavmec_jax.")


@functools.cache
def _hint(annotation: Any, kind: type) -> Any:
    """The annotation of a field, for NumPy arrays where the leaf is one."""
    if not issubclass(kind, np.ndarray | np.generic):
        return annotation
    options = [_hint(one, kind) for one in get_args(annotation)]
    if options:
        return functools.reduce(lambda a, b: a | b, options)
    if isinstance(annotation, type) and issubclass(annotation, AbstractArray):
        return annotation.dtype[np.ndarray | np.generic, annotation.dim_str]
    return annotation

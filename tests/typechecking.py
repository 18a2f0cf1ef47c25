"""The run-time type checker of the tests: beartype, and the fields of every pytree that crosses a function boundary.

Constructors of pytrees are not checked, since JAX also calls them with shapes and sentinels.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype
from beartype.door import is_bearable
from jaxtyping import AbstractArray, TypeCheckError, jaxtyped
from upath import UPath

_CONF = BeartypeConf(
    is_pep484_tower=True,  # an int is accepted where a float is asked for
    hint_overrides=FrozenDict({Path: Path | UPath}),  # and the path of an object store where a path is
)
_LEAVES = (jax.Array, np.ndarray, np.generic, int, float)
_passed: set[tuple] = set()
"""Signatures of pytrees that passed the check."""


def checked(function):
    """Check the arguments and the result of a function.

    jaxtyping calls this with a function that has the signature of one of the package and no body; the result of that one
    is then a further argument.
    """
    check = beartype(conf=_CONF)(function)

    @functools.wraps(function)
    def check_call(*args, **kwargs):
        if function.__name__ == "__init__" and _is_pytree(type(args[0])):
            return
        check(*args, **kwargs)
        for value in (*args, *kwargs.values()):
            check_fields(value)

    return check_call


def check_fields(tree: Any) -> None:
    """Check the fields of the package's pytrees in ``tree``: their types, and that the shapes of each fit together.

    Raises:
        TypeCheckError: a leaf has another dtype or shape than its field says.
    """
    if _is_pytree(type(tree)):
        types = _field_types(type(tree))
        children = [getattr(tree, name) for name in types]
        signature = (type(tree), *map(_leaf_signature, children))
        if signature not in _passed:
            with jaxtyped("context"):
                for (name, annotation), child in zip(types.items(), children, strict=True):
                    _check_leaf(f"{type(tree).__name__}.{name}", child, annotation)
            _passed.add(signature)
    elif isinstance(tree, tuple | list):
        children = tree
    elif isinstance(tree, dict):
        children = tree.values()
    else:
        return
    for child in children:
        check_fields(child)


def _leaf_signature(value: Any) -> tuple | None:
    """Return all that the check of a field depends on; ``None`` for what it does not look at."""
    if not isinstance(value, _LEAVES):
        return None
    return isinstance(value, jax.Array), getattr(value, "shape", None), getattr(value, "dtype", type(value))


def _check_leaf(name: str, value: Any, annotation: Any) -> None:
    if isinstance(value, _LEAVES) and not is_bearable(value, _hint(annotation, type(value)), conf=_CONF):
        description = f"{value.dtype}{list(value.shape)}" if hasattr(value, "shape") else repr(value)
        raise TypeCheckError(f"{name} is {description}; it should be {annotation}")


def _is_pytree(kind: type) -> bool:
    """Return whether a class is a flax dataclass or a named tuple of the package."""
    return kind.__module__.startswith("uavmec_jax.") and (
        hasattr(kind, "_flax_dataclass") or (issubclass(kind, tuple) and hasattr(kind, "_fields"))
    )


@functools.cache
def _field_types(kind: type) -> dict[str, Any]:
    if dataclasses.is_dataclass(kind):
        return {field.name: field.type for field in dataclasses.fields(kind)}
    return {name: kind.__annotations__[name] for name in kind._fields}


@functools.cache
def _hint(annotation: Any, kind: type) -> Any:
    """Return the annotation of a field, in terms of NumPy arrays if the leaf is one."""
    if not issubclass(kind, np.ndarray | np.generic):
        return annotation
    options = [_hint(option, kind) for option in get_args(annotation)]
    if options:
        return functools.reduce(lambda a, b: a | b, options)
    if isinstance(annotation, type) and issubclass(annotation, AbstractArray):
        return annotation.dtype[np.ndarray | np.generic, annotation.dim_str]
    return annotation

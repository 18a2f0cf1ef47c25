"""Hostile values in place of valid ones: numbers, arrays, keys, tables and pytrees; and which of them must be refused."""

import copy
import dataclasses
import math
from random import Random
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from fuzz_judge import INFINITE
from fuzz_mutations import NUMBERS, WORDS, Raw, edit

from uavmec_jax.env.params import Params

_NUMBERS = tuple(number for number in NUMBERS if not isinstance(number, Raw))
_SMALL = (float("nan"), float("inf"), float("-inf"), -0.0, -1, 0, 99, 2.5, 1e300, 1e-320, 2**31, 2**63, 10**30, True)
_TYPES = ("float64", "float32", "int32", "int8", "bool", "complex64", "U3", "object")

Range = tuple[float, float]

MANY: Range = (1, 10**6)
"""Range of numbers of things that are computed; more of them are not wrong, but take too long."""


OTHER_TYPE = "of another type or shape"
"""Reason of a value that is no number in a number's place: Python and JAX may refuse it in words of their own."""


def hostile(rng: Random, old: Any, name: str, allowed: Range | None) -> tuple[Any, str, str]:
    """Return a hostile value in place of a valid one, what it is, and why it must be refused."""
    if dataclasses.is_dataclass(old) and not isinstance(old, type):
        fields = [one for one in dataclasses.fields(old) if getattr(old, one.name) is not None]
        if fields and rng.random() < 0.95:
            chosen = rng.choice(fields)
            part, place, reason = hostile(rng, getattr(old, chosen.name), chosen.name, _range_of(old, chosen))
            return dataclasses.replace(old, **{chosen.name: part}), f"{name}.{place}", reason
    if isinstance(old, dict) and rng.random() < 0.9:
        edited = edit(rng, _plain(old), 1)
        return edited, f"{name} = {edited!r:.300}", OTHER_TYPE
    if isinstance(old, tuple) and old and rng.random() < 0.8:
        at = rng.randrange(len(old))
        part, place, reason = hostile(rng, old[at], name, allowed)
        return (*old[:at], part, *old[at + 1 :]), f"{place} at {at}", reason
    if isinstance(old, jax.Array | np.ndarray) and rng.random() < 0.9:
        return _hostile_array(rng, old, name, allowed)
    if isinstance(old, bool | int | float) and rng.random() < 0.8:
        number = rng.choice(_NUMBERS if rng.random() < 0.5 else _SMALL)
        if allowed == MANY and math.isfinite(number) and number > MANY[1]:
            number = -1
        return number, f"{name} = {number!r}", _reason(number, name, allowed)
    wrong = rng.choice(
        (None, "x", "", [], {}, (), object, b"x", 1j, [1, 2], np.zeros((2, 0)), np.nan, rng.choice(WORDS))
    )
    return wrong, f"{name} = {wrong!r:.100}", OTHER_TYPE


def _plain(data: Any) -> Any:
    """Return a copy whose tuples are lists."""
    if isinstance(data, dict):
        return {key: _plain(part) for key, part in data.items()}
    return [_plain(part) for part in data] if isinstance(data, list | tuple) else copy.copy(data)


def _hostile_array(rng: Random, old: Any, name: str, allowed: Range | None) -> tuple[Any, str, str]:
    if jax.dtypes.issubdtype(old.dtype, jax.dtypes.prng_key):
        wrong = rng.choice(
            (0, None, jnp.zeros(3), "x", np.zeros((2, 2), np.uint32), jnp.array([old, old]), old[..., None])
        )
        return wrong, f"{name} = {str(wrong)[:60]}", OTHER_TYPE
    array, what = np.array(old), rng.random()
    if what < 0.6 and array.size:
        number = rng.choice([one for one in _SMALL if abs(one) < 2**63 or not isinstance(one, int)])
        if array.dtype.kind in "iu" and (not isinstance(number, int) or abs(number) >= 2**31):
            array = array.astype(np.int64 if isinstance(number, int) else float)
        with np.errstate(all="ignore"):
            array.reshape(-1)[rng.randrange(array.size)] = number
        given = array if rng.random() < 0.5 else jnp.asarray(array)
        changed = float(np.asarray(given, float).reshape(-1)[0]) if array.size == 1 else float(number)
        reason = "" if old.dtype == bool else _reason(changed, name, allowed)
        return given, f"{name} has {number!r} ({given.dtype})", reason
    if what < 0.8:
        kind = rng.choice(_TYPES)
        return array.astype(kind), f"{name} is {kind}", OTHER_TYPE
    shapes = (
        array[None],
        array.reshape(-1),
        array[..., None],
        array[:0] if array.ndim else array[None],
        array.T,
        array.tolist(),
    )
    wrong = rng.choice(shapes)
    return wrong, f"{name} has the shape {np.shape(wrong)}", OTHER_TYPE


def _range_of(owner: Any, chosen: dataclasses.Field) -> Range | None:
    """Return the bounds of a parameter, from its declaration."""
    if not isinstance(owner, Params) or isinstance(chosen.default, bool | str):
        return None
    bounds = chosen.metadata
    tiny = float(np.finfo(np.float32).tiny)
    low = bounds.get("ge", tiny if "gt" in bounds else 0 if "lt" not in bounds else -math.inf)
    return low, bounds.get("le", math.inf)


def _reason(number: Any, name: str, allowed: Range | None) -> str:
    """Return why a number must be refused; whether it is in range is asked only where the range is known."""
    value = float(number)
    if math.isnan(value):
        return f"{name} is NaN"
    if math.isinf(value) and name not in INFINITE:
        return f"{name} is infinite"
    if allowed is not None and not allowed[0] <= value <= allowed[1]:
        return f"{name} is out of range"
    return ""

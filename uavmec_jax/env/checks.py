"""Checks of arguments: values that are known where a function is called are checked there, and cost a program nothing.

Values that ``jit`` or ``vmap`` traces are not known. They are checked inside :func:`debug_checks` only, by callbacks from the
compiled programs. Callbacks, not ``checkify``: a user's own ``jax.jit`` needs no change then.
"""

import dataclasses
import math
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from uavmec_jax.errors import ArgumentError

SMALLEST, LARGEST = 1e-6, 1e12
"""Bounds of quantities in SI units where nothing else is said: far beyond any device or UAV, and float32 holds products of a
few of them."""

LEAST_CAPACITY_J = 1e-3
"""Smallest capacity of a device's battery."""

MAX_LENGTH_M = 1e7
"""Largest coordinate, side of a region, altitude and signal range: beyond it, squares of distances lose their metres in
float32. Northings of networks in UTM come up to it."""

_INTEGERS = 2**31
"""JAX's integers have 32 bits: where NumPy's are larger, it would drop the upper bits without a word."""

_TINY = float(np.finfo(np.float32).tiny)  # in single precision, what is closer to 0 counts as 0,
_HUGE = float(np.finfo(np.float32).max)  # and what is further from 0 as infinite

_debugging = jax.make_user_context(False)
"""Whether traced values are checked: a part of the key of ``jit``'s caches, so other programs are compiled inside."""

_found: deque[ArgumentError] = deque(maxlen=16)
"""What compiled programs have found and nobody has raised yet; callbacks have no other way out."""

_T = TypeVar("_T")


@dataclass(frozen=True)
class Bounds:
    """The range of a number; NaN is in none.

    Attributes:
        ge: at least.
        gt: greater than.
        le: at most.
        lt: less than.
        whole: whether it has to be an integer.
        infinite: whether infinity is allowed.
    """

    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None
    whole: bool = False
    infinite: bool = False

    @classmethod
    def of(cls, field: dataclasses.Field, largest: float | None = None) -> "Bounds":
        """Return the bounds of a field of a dataclass: those in its metadata, else at least 0, and at most 1 for a bool.

        Args:
            field: its default is a number, infinite if infinity is allowed.
            largest: upper limit where the metadata have none.
        """
        given = {name: field.metadata[name] for name in ("ge", "gt", "le", "lt") if name in field.metadata}
        usual = {"ge": 0, "le": 1} if isinstance(field.default, bool) else {"ge": 0}
        infinite = isinstance(field.default, float) and math.isinf(field.default)
        return cls(**({"le": None if infinite else largest} | (given or usual)), infinite=infinite)

    def __str__(self) -> str:
        """Say what is allowed: ``a whole number from 0 to 11``."""
        kind = "a whole number" if self.whole else "a number" if self.infinite else "a finite number"
        if self.ge is not None and self.le is not None:
            return f"{kind} from {_shown(self.ge)} to {_shown(self.le)}"
        words = {"ge": "at least", "gt": "greater than", "le": "at most", "lt": "less than"}
        limits = {name: getattr(self, name) for name in words if getattr(self, name) is not None}
        of = " of " if "ge" in limits or set(limits) == {"le"} else " "
        return (kind + of + " and ".join(f"{words[name]} {_shown(limit)}" for name, limit in limits.items())).rstrip()

    def admits(self, value: float) -> bool:
        """Return whether a number is in the range; one too small for single precision counts as 0."""
        if isinstance(value, int) and not self.whole and not -_INTEGERS <= value < _INTEGERS:
            return False
        value = 0 if -_TINY < value < _TINY else value
        return (
            (self.ge is None or value >= self.ge)
            and (self.gt is None or value > self.gt)
            and (self.le is None or value <= self.le)
            and (self.lt is None or value < self.lt)
            and (value == value if self.infinite else -_HUGE <= value <= _HUGE)
        )


POSITION = Bounds(ge=-MAX_LENGTH_M, le=MAX_LENGTH_M)
"""Coordinates, m."""

CAPACITY = Bounds(ge=LEAST_CAPACITY_J, le=LARGEST)
"""Battery capacity of a device, J."""


class Check(NamedTuple):
    """A value that has to be in a range; ``axes`` names its last axes in messages, e.g. ``("device",)``."""

    name: str
    value: Any
    bounds: Bounds
    axes: tuple[str, ...] = ()


def check_range(name: str, value: Any, *, axes: tuple[str, ...] = (), **bounds: Any) -> None:
    """Check that a number, or every number of an array, is in a range: ``check_range("samples", 0, ge=1, whole=True)``.

    Raises:
        ArgumentError: one line with the name, the value and the range. Traced values pass, see :func:`debug_checks`.
    """
    check_ranges([Check(name, value, Bounds(**bounds), axes)])


def check_ranges(checks: Sequence[Check]) -> None:
    """Make several checks at once; see :func:`check_range`."""
    traced = []
    for check in checks:
        if isinstance(check.value, jax.core.Tracer):
            traced.append(check)
        else:
            _check_known(check)
    if traced and _debugging.value:
        jax.debug.callback(
            partial(_record, [check._replace(value=None) for check in traced]), [c.value for c in traced]
        )


def check_shape(name: str, value: Any, shape: tuple[int, ...], what: str) -> None:
    """Check the last axes of an array, known or traced; ``what`` says in messages what they stand for.

    Raises:
        ArgumentError: one line.
    """
    found = tuple(np.shape(value))
    if found[len(found) - len(shape) :] != shape or len(found) < len(shape):
        raise ArgumentError(f"{name} has shape {found}; it should be {shape}, {what}")


def check_pair(name: str, value: Any) -> None:
    """Check that a value is two numbers, or two arrays of a batch.

    Raises:
        ArgumentError: one line.
    """
    numbers = (len(value),) if isinstance(value, tuple | list) else np.shape(value)[:1]
    if numbers != (2,):
        raise ArgumentError(f"{name} is {value!r}; it should be two numbers")


def check_rising(name: str, value: Any) -> None:
    """Check that a range is two numbers, ``(low, high)``, of which the second is not the smaller one, if they are known.

    Raises:
        ArgumentError: one line.
    """
    check_pair(name, value)
    low, high = value
    if not is_traced((low, high)) and np.any(np.asarray(low) > np.asarray(high)):
        raise ArgumentError(f"{name} is ({low}, {high}); it should be (low, high) with low <= high")


def check_bool(name: str, value: Any) -> None:
    """Check that an array, known or traced, holds True and False and no numbers.

    Raises:
        ArgumentError: one line.
    """
    dtype = value.dtype if hasattr(value, "dtype") else np.asarray(value).dtype
    if dtype.kind != "b":
        raise ArgumentError(f"{name} has the dtype {dtype}; it should be bool")


@contextmanager
def debug_checks() -> Iterator[None]:
    """Check traced values, too, in what is called inside the context: ``with um.debug_checks(): jax.jit(f)(x)``.

    Functions that are compiled inside, also those that were compiled outside before, contain callbacks that check actions,
    volumes, energies, layouts and parameters while they run. They are slow, and for debugging. What is compiled outside has
    no trace of them. A value that a check refuses does not stop the program: it goes on as documented (a bad action is
    clamped), and the error comes from the next call of a function of this package, or at the latest at the end of the
    context, which waits for all programs. ``UavMecEnv`` raises it in the same call.

    Raises:
        ArgumentError: a value was refused: one line with its name, the value and its range.
    """
    _found.clear()
    with _debugging(True):
        try:
            yield
        except ArgumentError:
            raise
        except Exception as error:  # maybe what the bad value led to
            _raise_found(error)
            raise
        _raise_found()


def is_traced(tree: Any) -> bool:
    """Return whether any leaf of a pytree is traced."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def settled(result: _T) -> _T:
    """Return the result of a program; inside :func:`debug_checks`, wait for it and raise what it found."""
    if _debugging.value:
        _raise_found()
    return result


def _raise_found(cause: Exception | None = None) -> None:
    """Raise the first thing that a compiled program found."""
    jax.effects_barrier()
    if _found:
        first = _found.popleft()
        _found.clear()
        raise first from cause


def _record(checks: list[Check], values: list[Any]) -> None:
    """Make the checks of traced values; called by compiled programs, from threads of theirs."""
    for check, value in zip(checks, values, strict=True):
        try:
            _check_known(check._replace(value=value))
        except ArgumentError as error:
            _found.append(error)


def _check_known(check: Check) -> None:
    """Check a value that is not traced."""
    name, value, bounds, axes = check
    known_type = type(value) is int or (type(value) is float and not bounds.whole)
    if known_type and bounds.admits(value):  # most parameters: no need for an array
        return
    try:
        array = np.asarray(value)
    except ValueError:  # a list of lists of different lengths
        raise ArgumentError(f"{name} is {value!r}; it should be {bounds}") from None
    if array.dtype.kind not in ("iu" if bounds.whole else "biuf"):
        shown = repr(value if array.dtype.kind == "O" else array.tolist() if array.ndim == 0 else array)
        raise ArgumentError(f"{name} is {shown}; it should be {bounds}")
    if array.size == 0 or (bounds.admits(array.min().item()) and bounds.admits(array.max().item())):
        return  # a NaN would be the smallest and the largest
    for index in np.ndindex(array.shape):
        if not bounds.admits(number := array[index].item()):
            a_float = ", and a float" if bounds.admits(float(number)) else ""
            raise ArgumentError(f"{name}{_place(index, axes)} is {_shown(number)}; it should be {bounds}{a_float}")


def _place(index: tuple[int, ...], axes: tuple[str, ...]) -> str:
    """Say where in an array a value is, counted from 1; axes in front of the named ones are those of a batch."""
    if not index:
        return ""
    names = ("entry",) * (len(index) - len(axes)) + axes[max(len(axes) - len(index), 0) :]
    return " of " + ", ".join(f"{name} {i + 1}" for name, i in zip(names, index, strict=True) if name)


def _shown(value: float) -> str:
    """Return a number as messages show it."""
    return f"{value}" if isinstance(value, int) else f"{value:g}"

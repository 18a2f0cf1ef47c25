"""Verdicts on inputs: accepted with finite numbers, refused in one line with nothing written, or a failure."""

import dataclasses
import os
import re
import resource
import signal
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import numpy as np
import pandas as pd
from pydantic import BaseModel

import uavmec_jax
from uavmec_jax.errors import MAX_MESSAGE, UserError

SLOW_S = 2.0
"""Seconds that one input may take, of the processor's time where others share it."""

HANG_S = 10.0
MEMORY_BYTES = 300e6
"""Most bytes by which an input may raise the largest memory of the process."""

INFINITE = frozenset({"uplink_rate_bit_s", "window_s", "pads", "packs", "processing_rate"})
"""Fields whose infinity is documented: there is no limit, or padding has nothing to do."""

UNKNOWN = frozenset({"failure_slot", "returns_in", "returns_in_s", "low", "high"})
"""Fields whose NaN is documented: there is no such number."""

_CLEAR, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")
_PACKAGE = Path(uavmec_jax.__file__).parent


class HangError(BaseException):
    """An input takes too long; no `except Exception` may swallow it."""


class ReachedError(Exception):
    """An input was accepted: heavy work would begin here. Its arguments are those of that work."""


class Refused(Exception):  # noqa: N818  (no error of the script's)
    """An input was refused in a way that raises nothing; the argument is the message."""


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What became of an input.

    Attributes:
        outcome: ``accepted``, ``refused`` or ``failure``.
        what: of a failure, its kind: ``traceback``, ``message``, ``written``, ``not finite``, ``nonsense``, ``warning``,
            ``slow``, ``hang`` or ``memory``.
        where: the innermost function of the package that it came from.
        message: of the refusal or the failure.
        seconds: time it took.
        trace: of a failure, the traceback.
    """

    outcome: str
    what: str = ""
    where: str = ""
    message: str = ""
    seconds: float = 0.0
    trace: str = ""


@contextmanager
def alarm(seconds: float) -> Iterator[None]:
    """Raise HangError after so many seconds, and every second after that: an error in a callback of a library is ignored.

    Code that never returns to Python is ended by the parent process.
    """

    def ring(number: int, frame: Any) -> None:
        raise HangError(f"takes more than {seconds:g} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


_OF_ANOTHER_TYPE = (
    TypeError,
    ValueError,
    AttributeError,
    AssertionError,
    LookupError,
    OverflowError,
    NotImplementedError,
)
"""What Python, chex and JAX raise for an argument of another type or shape."""


def judge(
    load: Callable[[], Any],
    folder: Path,
    *,
    may_be_infinite: frozenset[str] = INFINITE,
    may_be_nan: bool = False,
    may_write: bool = False,
    must_refuse: str = "",
    other_type: bool = False,
    finite: bool = True,
    slow_s: float = SLOW_S,
    hang_s: float = HANG_S,
) -> Verdict:
    """Load an input and judge what happens.

    Args:
        load: loads it.
        folder: nothing in it may change if the input is refused.
        may_be_infinite: names of fields that may be infinite.
        may_be_nan: whether what is loaded may hold NaN, as results do for what was not evaluated.
        may_write: whether a refusal may change the folder.
        must_refuse: why the input must not be accepted, if it must not.
        other_type: whether the input is of another type or shape, so that Python and JAX may refuse it in words of their own.
        finite: whether what is loaded must be finite.
        slow_s, hang_s: seconds after which it is slow, and given up.
    """
    before, memory, started, worked = snapshot(folder), _reset_peak(), time.perf_counter(), time.process_time()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", RuntimeWarning)
        verdict = _judge(load, (may_be_infinite, may_be_nan) if finite else None, must_refuse, other_type, hang_s)
    seconds = min(time.perf_counter() - started, time.process_time() - worked)
    if not may_write and verdict.outcome == "refused" and (changed := _changed(before, snapshot(folder))):
        verdict = Verdict("failure", "written", verdict.where, f"{changed} (refused: {verdict.message})")
    if verdict.outcome != "failure":
        numeric = [one for one in warned if issubclass(one.category, RuntimeWarning)]
        grown = _peak() - memory
        if numeric:
            place = f"{_short(numeric[0].filename)}:{numeric[0].lineno}"
            verdict = Verdict("failure", "warning", place, str(numeric[0].message))
        elif grown > MEMORY_BYTES:
            verdict = Verdict("failure", "memory", verdict.where, f"{grown / 1e6:.0f} MB more")
        elif seconds > slow_s:
            verdict = Verdict("failure", "slow", verdict.where, f"{seconds:.1f} s, {verdict.outcome}")
    return dataclasses.replace(verdict, seconds=seconds)


def _judge(
    load: Callable[[], Any],
    finite_but: tuple[frozenset[str], bool] | None,
    must_refuse: str,
    other_type: bool,
    hang_s: float,
) -> Verdict:
    try:
        with alarm(hang_s):
            try:
                loaded = load()
            except ReachedError as reached:
                loaded = reached.args
            found = not_finite(loaded, *finite_but) if finite_but else ""
    except HangError as error:
        return Verdict("failure", "hang", location(error.__traceback__), str(error))
    except Refused as refused:
        return refusal(str(refused), "")
    except UserError as error:
        return refusal(str(error), location(error.__traceback__))
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        if other_type and isinstance(error, _OF_ANOTHER_TYPE):
            return Verdict("refused", where=location(error.__traceback__), message=type(error).__name__)
        try:
            text = f"{type(error).__name__}: {str(error)[:200]}"
        except Exception as unprintable:
            text = f"{type(error).__name__}, whose message cannot be printed: {unprintable!r:.100}"
        where = f"{location(error.__traceback__)} {type(error).__name__}"
        return Verdict("failure", "traceback", where, text, trace="".join(traceback.format_tb(error.__traceback__)))
    if found:
        return Verdict("failure", "not finite", found)
    if must_refuse:
        return Verdict("failure", "nonsense", must_refuse)
    return Verdict("accepted")


def refusal(message: str, where: str) -> Verdict:
    """Return the verdict on a message that refuses an input."""
    wrong = (
        "has several lines"
        if len(message.splitlines()) != 1
        else f"has {len(message)} characters"
        if len(message) > MAX_MESSAGE
        else "cannot be printed"
        if not message.isprintable()
        else ""
    )
    if wrong:
        return Verdict("failure", "message", where or message[:40], f"{wrong}: {message[:200]!r}")
    return Verdict("refused", where=where, message=message)


def location(trace: TracebackType | None) -> str:
    """Return the innermost line of the package in a traceback, else the innermost line of all."""
    frames = traceback.extract_tb(trace)
    ours = [frame for frame in frames if frame.filename.startswith(f"{_PACKAGE}{os.sep}")]
    if not frames:
        return ""
    frame = (ours or frames)[-1]
    return f"{_short(frame.filename)}:{frame.lineno} {frame.name}"


def _short(file: str) -> str:
    """Return a path as it is in the repository, or in the folder of a library."""
    return (
        str(Path(file).relative_to(_PACKAGE))
        if file.startswith(f"{_PACKAGE}{os.sep}")
        else "/".join(file.split("/")[-2:])
    )


def snapshot(folder: Path) -> dict[str, tuple[int, int, int]]:
    """Return size, time and mode of everything in a folder."""
    found = {}
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = os.path.join(parent, name)
            facts = os.lstat(path)
            found[path[len(str(folder)) + 1 :]] = (
                (0, 0, facts.st_mode) if name in folders else (facts.st_size, facts.st_mtime_ns, facts.st_mode)
            )
    return found


def _changed(before: dict[str, Any], after: dict[str, Any]) -> str:
    """Say what differs between two snapshots."""
    return ", ".join(sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name)))[:150]


def _reset_peak() -> int:
    """Forget the largest memory that this process has had; return what it has now. (Only Linux can forget.)"""
    with suppress(OSError):
        _CLEAR.write_text("5", encoding="ascii")
    return _peak()


def _peak() -> int:
    """Return the largest memory of this process, in bytes."""
    try:
        return int(re.search(r"VmHWM:\s+(\d+)", _STATUS.read_text(encoding="ascii", errors="replace"))[1]) * 1024  # type: ignore[index]
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def not_finite(value: Any, may_be_infinite: frozenset[str] = INFINITE, may_be_nan: bool = False, name: str = "") -> str:
    """Return the name of the first number in a tree that is not finite, empty if all are."""
    if isinstance(value, np.ndarray | jax.Array | np.generic | float | complex):
        return _array_not_finite(value, may_be_infinite, may_be_nan, name)
    parts: Any = ()
    if isinstance(value, pd.DataFrame):
        parts = ((column, value[column].to_numpy()) for column in value)
    elif isinstance(value, BaseModel):
        parts = value.__dict__.items()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
    elif isinstance(value, Mapping):
        parts = value.items()
    elif isinstance(value, list | tuple | set | frozenset):
        parts = ((name, part) for part in value)
    for key, part in parts:
        if found := not_finite(part, may_be_infinite, may_be_nan, str(key)):
            return found if found.startswith(str(key)) or not name else f"{name}.{found}"
    return ""


def _array_not_finite(value: Any, may_be_infinite: frozenset[str], may_be_nan: bool, name: str) -> str:
    if isinstance(value, jax.Array) and jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
        return ""
    array = np.asarray(value)
    if array.dtype.kind == "c":
        return f"{name} is complex"
    if array.dtype.kind != "f":
        return ""
    if not may_be_nan and name not in UNKNOWN and np.isnan(array).any():
        return f"{name} is NaN"
    return f"{name} is infinite" if name not in may_be_infinite and np.isinf(array).any() else ""

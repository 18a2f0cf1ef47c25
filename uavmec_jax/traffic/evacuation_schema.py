"""What the file of an evacuation may hold: the facts of its header, and its arrays; a right checksum proves neither."""

from collections.abc import Callable, Mapping
from typing import Annotated, Any

import numpy as np
import pydantic
from pydantic import Field

from uavmec_jax.env.checks import MAX_LENGTH_M
from uavmec_jax.env.params import MAX_DEVICES
from uavmec_jax.errors import TrafficError
from uavmec_jax.files.validation import PrintableName, PrintableText, StrictModel, from_array, validated

MAX_DENSITY = 1e7
"""Largest density, in vehicles per km and lane: a vehicle on the shortest road that SUMO builds counts 10,000."""

MAX_LANES = 100
MAX_WINDOWS = 1000
MAX_ROADS = 1_000_000

_Count = Annotated[int, Field(ge=0, le=10**12)]
_Seconds = Annotated[float, Field(ge=0, le=1e7)]
_Counts = Annotated[tuple[_Count, ...], from_array]


class EvacuationMeta(StrictModel):
    """Facts about an evacuation; see :class:`uavmec_jax.traffic.evacuation.Evacuation`."""

    place: PrintableName
    description: PrintableText
    names: Annotated[tuple[PrintableName, ...], Field(min_length=2, max_length=MAX_DEVICES), from_array]
    roads: Annotated[tuple[PrintableText, ...], Field(min_length=1, max_length=MAX_ROADS), from_array]
    window_s: Annotated[float, Field(gt=0, le=1e7)]
    mean_s: Annotated[tuple[_Seconds, _Seconds], from_array]
    mean_windows: Annotated[tuple[_Count, _Count], from_array]
    radius_m: Annotated[float, Field(gt=0, le=1e7)]
    vehicles: Annotated[int, Field(ge=1, le=1_000_000)]
    seeds: Annotated[int, Field(ge=1, le=1000)]
    loaded: _Counts
    unfinished: _Counts
    teleports: _Counts
    cut_off: _Count
    warnings: Annotated[tuple[PrintableText, ...], Field(max_length=100), from_array]
    sumo: PrintableText
    network_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    command: str
    settings: dict[str, Any]

    @pydantic.model_validator(mode="after")
    def _check(self) -> "EvacuationMeta":
        for field in ("names", "roads"):
            if (twice := _repeated(getattr(self, field))) is not None:
                raise ValueError(f"meta.{field} has {twice!r} twice; they must differ")
        for field in ("loaded", "unfinished", "teleports"):
            if (count := len(getattr(self, field))) != self.seeds:
                raise ValueError(f"meta.{field} has {count} numbers; there are {self.seeds} seeds")
        first, last = self.mean_windows
        if not first < last:
            raise ValueError(f"meta.mean_windows is [{first}, {last}]; give the first window and one past the last")
        if not np.allclose(self.mean_s, (first * self.window_s, last * self.window_s), rtol=1e-6):
            raise ValueError(
                f"meta.mean_s is {list(self.mean_s)}; windows {first} to {last} of {self.window_s:g} s are "
                f"[{first * self.window_s:g}, {last * self.window_s:g}]"
            )
        return self


class _Header(StrictModel):
    """The part of a file's header that is ours, so that messages begin with ``meta.``"""

    meta: EvacuationMeta


def check_evacuation(source: object, meta: Any, arrays: Mapping[str, np.ndarray]) -> None:
    """Check the facts and the arrays of an evacuation.

    Args:
        source: the file, which begins the messages.
        meta: what should be the facts.
        arrays: by the names of the fields of an ``Evacuation``; all of them are there.

    Raises:
        TrafficError: something is not what it should be; one line that names the field, and the device, road or window.
    """
    facts = validated(_Header, {"meta": meta}, source, TrafficError).meta
    _check_types(source, arrays)
    _check_shapes(source, facts, arrays)

    def device(k: int) -> str:
        return f"device {k + 1} ({facts.names[k]})"

    def road(k: int) -> str:
        return f"road {k + 1} ({facts.roads[k]})"

    def corner(k: int) -> str:
        return f"corner {k + 1}"

    corners = len(arrays["road_shape"])
    ranges: tuple[tuple[str, float, float, Callable[[int], str]], ...] = (
        ("position", -MAX_LENGTH_M, MAX_LENGTH_M, device),
        ("density", 0, MAX_DENSITY, device),
        ("density_spread", 0, MAX_DENSITY, device),
        ("weight", 0, 1, device),
        ("window_weight", 0, 1, device),
        ("road_shape", -MAX_LENGTH_M, MAX_LENGTH_M, corner),
        ("road_corners", 2, corners, road),
        ("road_lanes", 1, MAX_LANES, road),
        ("road_density", 0, MAX_DENSITY, road),
    )
    for name, low, high, owner in ranges:
        _check_range(source, name, arrays[name], (low, high), owner)
    if (total := int(arrays["road_corners"].sum())) != corners:
        raise TrafficError(f"{source}: road_corners has a sum of {total}, but road_shape has {corners} corners")


def _check_types(source: object, arrays: Mapping[str, np.ndarray]) -> None:
    """Check that the arrays hold numbers that JAX takes: in this machine's order of bytes, and of the usual sizes."""
    for name, array in arrays.items():
        whole = name in ("road_corners", "road_lanes")
        if array.dtype not in ((np.int32, np.int64) if whole else (np.float32, np.float64)):
            kinds = "int32 or int64" if whole else "float32 or float64"
            raise TrafficError(f"{source}: {name} is of type {array.dtype}; it should be {kinds}")


def _check_shapes(source: object, meta: EvacuationMeta, arrays: Mapping[str, np.ndarray]) -> None:
    """Check that the arrays agree with each other and with the facts."""
    n, roads = len(meta.names), len(meta.roads)
    windows, corners = (len(arrays[name]) if arrays[name].ndim else 0 for name in ("window_weight", "road_shape"))
    shapes = {
        "position": (n, 2),
        "density": (n,),
        "density_spread": (n,),
        "weight": (n,),
        "window_weight": (windows, n),
        "road_shape": (corners, 2),
        "road_corners": (roads,),
        "road_lanes": (roads,),
        "road_density": (windows, roads),
    }
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise TrafficError(
                f"{source}: {name} has the shape {arrays[name].shape}; for {n} devices, {roads} roads and {windows} "
                f"windows it should be {shape}"
            )
    if not 1 <= windows <= MAX_WINDOWS:
        raise TrafficError(f"{source}: window_weight has {windows} windows; it should have 1 to {MAX_WINDOWS}")
    if (last := meta.mean_windows[1]) > windows:
        raise TrafficError(f"{source}: meta.mean_windows ends at {last}; there are {windows} windows")


def _check_range(
    source: object, name: str, array: np.ndarray, limits: tuple[float, float], owner: Callable[[int], str]
) -> None:
    """Check that all numbers are finite and within limits; ``owner`` names a device, a road or a corner by its index."""
    low, high = limits
    with np.errstate(invalid="ignore"):  # NaN
        wrong = ~((array >= low) & (array <= high))
    if not wrong.any():
        return
    where = np.unravel_index(int(wrong.argmax()), array.shape)
    subject, value = f"{name} of {owner(int(where[0]))}", array[where]
    if name in ("window_weight", "road_density"):
        subject = f"{name} of {owner(int(where[1]))} in window {int(where[0]) + 1}"
    raise TrafficError(f"{source}: {subject} is {value:g}; it should be a number from {low:g} to {high:g}")


def _repeated(names: tuple[str, ...]) -> str | None:
    """Return the first name that was there before."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            return name
        seen.add(name)
    return None

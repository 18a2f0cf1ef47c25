"""How numbers of a cell are written in tables."""

from collections.abc import Iterable
from typing import Any


def half_interval(low: float, high: float) -> str:
    """Half an interval as ±; ±? where there is none."""
    return f" ±{(high - low) / 2:.1f}" if high == high else " ±?"


def axis_values(cell: Any, axes: Iterable[str]) -> list[str]:
    """The values of a cell on some axes; numbers without trailing zeros."""
    return [value if isinstance(value := cell[name], str) else f"{value:g}" for name in axes]


def first_to_fail(device: Any) -> str:
    """A device's number (from 1), or the UAV where no device fails."""
    return f"#{int(device)}" if device else "UAV"

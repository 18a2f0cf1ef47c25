"""Formatting of numbers in tables."""

from collections.abc import Iterable
from typing import Any


def half_interval(low: float, high: float) -> str:
    """Format half the width of an interval as ±; as ±? if the interval is unknown (NaN)."""
    return f" ±{(high - low) / 2:.1f}" if high == high else " ±?"


def axis_values(cell: Any, axes: Iterable[str]) -> list[str]:
    """Format the values of a cell on some axes, numbers without trailing zeros."""
    return [value if isinstance(value := cell[axis], str) else f"{value:g}" for axis in axes]


def first_to_fail(device: Any) -> str:
    """Format the number (from 1) of the device that fails first; ``UAV`` where no device fails."""
    return f"#{int(device)}" if device else "UAV"


def column_name(policy: str) -> str:
    """Format the name of a policy, as in the columns of results, as the title of a column."""
    return policy.replace("_", "-")

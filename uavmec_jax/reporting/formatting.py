"""Formatting of numbers in tables."""

from collections.abc import Iterable
from typing import Any


def half_interval(low: float, high: float) -> str:
    """Format half the width of an interval as ±; as ±? if the interval is unknown (NaN)."""
    return f" ±{(high - low) / 2:.1f}" if high == high else " ±?"


def axis_values(cell: Any, axes: Iterable[str]) -> list[str]:
    """Format the values of a cell on some axes, numbers without trailing zeros."""
    return [value if isinstance(value := cell[axis], str) else f"{value:g}" for axis in axes]


def slots(lifetime: float) -> str:
    """Format a lifetime; as - if it is missing (NaN)."""
    return f"{lifetime:.1f}" if lifetime == lifetime else "-"


def percent(gap: float) -> str:
    """Format a gap in percent; as - if it is missing (NaN)."""
    return f"{gap:+.1f}" if gap == gap else "-"


def censored(cell: Any, policy: str) -> str:
    """Format the share of a policy's episodes in a cell that are censored; empty if there are none."""
    return censored_share(cell.get(f"{policy}_censored", 0.0))


def censored_share(share: float) -> str:
    """Format a share of censored episodes; empty if there are none."""
    return f" ({share:.0%} censored)" if share > 0 else ""


def is_censored(cell: Any, policy: str) -> bool:
    """Return whether some of a policy's episodes in a cell are censored; their mean lifetime is then at least the number."""
    return bool(cell.get(f"{policy}_censored", 0.0) > 0)


def cell_name(cell: Any, axes: Iterable[str]) -> str:
    """Format the values of a cell as its name: ``8/6`` for the counts of devices, and the other axes by name."""
    counts, others = [], []
    for axis in axes:
        (value,) = axis_values(cell, [axis])
        counts += [value] * (axis in ("powered", "connected"))
        others += [f"{axis} {value}"] * (axis not in ("powered", "connected"))
    return ", ".join(["/".join(counts)] * bool(counts) + others)


def first_to_fail(device: Any) -> str:
    """Format the number (from 1) of the device that fails first; ``UAV`` where no device fails, - if it is missing."""
    if device != device:
        return "-"
    return f"#{int(device)}" if device else "UAV"


def column_name(policy: str) -> str:
    """Format the name of a policy, as in the columns of results, as the title of a column."""
    return policy.replace("_", "-")

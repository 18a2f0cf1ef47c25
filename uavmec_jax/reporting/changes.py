"""Repairs and removals of single devices, as tables and as plain data."""

from collections.abc import Sequence
from typing import Any

from rich.table import Table

from uavmec_jax.planning.changes import WhatIf
from uavmec_jax.reporting.labels import device_label


def change_table(changes: Sequence[WhatIf], names: Sequence[str]) -> Table:
    """Return a table of repairs and removals, the largest gain first: lifetimes, or where the end is a horizon, service."""
    of_service = any(change.service is not None for change in changes)
    table = Table()
    value, gain = ("in service", "gain, points") if of_service else ("lifetime", "gain")
    for column in ("rank", "device", "change", value, gain):
        table.add_column(column, justify="left" if column in ("device", "change") else "right")
    for rank, change in enumerate(changes, 1):
        if change.service is None:
            more = "≥ " * change.at_least
            numbers = (f"{more}{change.lifetime:.2f}", f"{more}{change.gain:+.2f}")
        else:
            numbers = (f"{change.service:.1%}", f"{100 * change.gain:+.1f}")
        table.add_row(str(rank), device_label(change.device + 1, names[change.device]), change.change, *numbers)
    return table


def change_data(changes: Sequence[WhatIf], names: Sequence[str]) -> list[dict[str, Any]]:
    """Return repairs and removals as plain data; devices are numbered from 1."""
    return [
        {
            "device": change.device + 1,
            "name": names[change.device],
            "change": change.change,
            **({"lifetime": change.lifetime} if change.service is None else {"service": change.service}),
            "gain": change.gain,
        }
        for change in changes
    ]

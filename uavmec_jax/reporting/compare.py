"""Tables of comparisons: of two runs, and of one policy with others on one scenario."""

import json
from typing import Any

import pandas as pd
from rich.table import Table
from rich.text import Text

from uavmec_jax.reporting.formatting import axis_values, cell_name, censored_share, first_to_fail, half_interval
from uavmec_jax.studies.compare import Side, differences, mostly_censored, overall, pair

_MEASURES = {
    "difference": "mean paired difference B - A, slots",
    "iqm_a": "interquartile mean of A, slots",
    "iqm_b": "interquartile mean of B, slots",
    "improvement": "probability that B lives longer than A",
}


_NO_FAILURE = ("none", "horizon", "share")
"""Causes of an end without which no device failed first, but not for want of a UAV."""


def comparison(a: Side, b: Side) -> tuple[dict[str, Table], dict[str, Any]]:
    """Compare two runs; return tables by title, and the same as plain data.

    Raises:
        StudyError: the runs have nothing to compare.
    """
    pairs, axes = pair(a, b)
    cells, measures = differences(pairs, axes), overall(pairs, axes)
    left_out = mostly_censored(pairs, axes)
    names = [cell_name(cell, axes) for _, cell in pairs[left_out].drop_duplicates(axes).iterrows()]
    over = f"Over all {len(cells)} cells, {len(pairs)} pairs"
    if names:
        kept = f"{len(cells) - len(names)} of {len(cells)} cells, {(~left_out).sum()} pairs"
        over = f"Over {kept}; half or more of the episodes are censored (reach max_slots) in {'; '.join(names)}"
    tables = {
        f"Lifetime in slots, seed by seed. A: {a.name}; B: {b.name}": _cell_table(cells, axes),
        over: _measure_table(measures),
    }
    data = {
        "a": a.name,
        "b": b.name,
        "pairs": len(pairs),
        "cells": json.loads(cells.to_json(orient="records")),
        "overall": {
            name: dict(zip(("value", "low", "high"), values, strict=True)) for name, values in measures.items()
        },
    } | ({"left_out": names} if names else {})
    return tables, data


def _cell_table(cells: pd.DataFrame, axes: list[str]) -> Table:
    table = Table()
    for column in (*axes, "seeds", "A", "B", "B - A"):
        table.add_column(column, justify="right")
    for _, cell in cells.iterrows():
        style = "green" if cell["low"] > 0 else "red" if cell["high"] < 0 else "default"
        difference = Text(f"{cell['difference']:+.2f}", style=style)
        difference.append(half_interval(cell["low"], cell["high"]), style="dim")
        shares = [cell.get(f"censored_{side}", 0.0) for side in "ab"]
        means = [f"{cell[side]:.2f}{censored_share(share)}" for side, share in zip("ab", shares, strict=True)]
        table.add_row(*axis_values(cell, (*axes, "seeds")), *means, difference)
    return table


def _measure_table(measures: dict[str, tuple[float, float, float]]) -> Table:
    table = Table()
    table.add_column("measure")
    for column in ("value", "95 %"):
        table.add_column(column, justify="right")
    for name, description in _MEASURES.items():
        value, low, high = measures[name]
        table.add_row(description, f"{value:.3f}", f"{low:.3f} to {high:.3f}" if low == low else "-")
    return table


def evaluation_table(rows: list[dict[str, Any]]) -> Table:
    """Return a table with one row per policy on one scenario.

    Args:
        rows: from :func:`uavmec_jax.studies.policy_evaluation.evaluate_policy`.
    """
    table = Table()
    of_service = "service" in rows[0]
    measured = ("in service",) if of_service else ("lifetime, slots", "shortest", "longest")
    for column in ("policy", *measured, "ends by", "first to fail"):
        table.add_column(column, justify="left" if column == "policy" else "right")
    for row in rows:
        numbers = [_service(row)] if of_service else [_lifetime(row), str(row["shortest"]), str(row["longest"])]
        device = "none" if row["cause"] in _NO_FAILURE else "UAV"
        if row["first_device"]:
            device = f"{first_to_fail(row['first_device'])} {row['first_share']:.0%}"
        table.add_row(row["policy"], *numbers, row["cause"], device)
    return table


def _lifetime(row: dict[str, Any]) -> Text:
    text = Text(f"{row['mean']:.2f}").append(half_interval(row["low"], row["high"]), style="dim")
    return text.append(censored_share(row.get("censored", 0.0)))


def _service(row: dict[str, Any]) -> Text:
    text = Text(f"{row['service']:.1%}")
    text.append(half_interval(100 * row["service_low"], 100 * row["service_high"]), style="dim")
    return text.append(censored_share(row["censored"]))

"""Advice for the next slot as tables for the terminal and as plain data for programs."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.planning.advice import Advice
from uavmec_jax.reporting.plan import change_data, change_table, device_label

_MAX_ROWS = 5
"""Rows of each table on the terminal; ``--json`` has all."""

_CAUSES = {
    Cause.BATTERY: "a device's battery",
    Cause.DATA_AGE: "expired data",
    Cause.UAV: "the UAV's battery",
    Cause.NONE: "the time limit",
}


def advice_data(advice: Advice, names: Sequence[str]) -> dict[str, Any]:
    """Return the advice as plain data.

    Args:
        advice: for one state.
        names: of the devices.

    Returns:
        ``next``, ``policy_says``, ``ranking``, ``lifetime``, ``first_failure``, ``failure_slot``, ``no_device_fails``,
        ``causes``, ``what_if``; devices by number (from 1) and name.
    """
    forecast = advice.forecast
    low, high = forecast.interval
    mean = float(forecast.lifetimes.mean())
    return {
        "next": {"device": advice.device + 1, "name": names[advice.device]},
        "policy_says": {"device": advice.policy_choice + 1, "name": names[advice.policy_choice]},
        "ranking": [
            {
                "device": candidate.device + 1,
                "name": names[candidate.device],
                "lifetime": round(candidate.lifetime, 4),
                "behind": round(candidate.behind, 4),
                "behind_interval": [round(candidate.behind_low, 4), round(candidate.behind_high, 4)],
            }
            for candidate in advice.candidates
        ],
        "lifetime": {"mean": round(mean, 4), "interval": [low, high], "futures": len(forecast.lifetimes)},
        "first_failure": {
            name: round(float(probability), 4) for name, probability in zip(names, forecast.first_failure, strict=True)
        },
        "failure_slot": {
            name: round(float(slot), 2)
            for name, slot in zip(names, forecast.failure_slot, strict=True)
            if np.isfinite(slot)
        },
        "no_device_fails": round(forecast.no_failure, 4),
        "causes": {cause.name.lower(): share for cause, share in forecast.causes.items()},
        "what_if": [
            row | {"lifetime": round(row["lifetime"], 4), "gain": round(row["gain"], 4)}
            for row in change_data(advice.what_if, names)
        ],
    }


def advice_tables(advice: Advice, names: Sequence[str]) -> dict[str, Table]:
    """Return tables by title: the next visit and its alternatives, the first failure, and the gains of repairs."""
    tables = {"Visit next": _ranking_table(advice, names), "First to fail": _failure_table(advice, names)}
    if advice.what_if:
        tables["What a repair or a removal would bring now, slots"] = change_table(advice.what_if[:_MAX_ROWS], names)
    return tables


def _ranking_table(advice: Advice, names: Sequence[str]) -> Table:
    table = Table()
    for column in ("rank", "device", "lifetime", "behind the first", ""):
        table.add_column(column, justify="left" if column in ("device", "") else "right")
    for rank, candidate in enumerate(advice.candidates[:_MAX_ROWS], 1):
        half = (candidate.behind_high - candidate.behind_low) / 2
        behind = f"{candidate.behind:.2f} ±{half:.2f}" if rank > 1 else "-"
        note = "the policy's choice" if candidate.device == advice.policy_choice else ""
        label = device_label(candidate.device + 1, names[candidate.device])
        table.add_row(str(rank), label, f"{candidate.lifetime:.2f}", behind, note)
    return table


def _failure_table(advice: Advice, names: Sequence[str]) -> Table:
    forecast, table = advice.forecast, Table()
    for column in ("device", "probability", "in slot"):
        table.add_column(column, justify="left" if column == "device" else "right")
    for device in np.argsort(-forecast.first_failure, kind="stable")[:_MAX_ROWS].tolist():
        if forecast.first_failure[device] > 0:
            slot = f"{forecast.failure_slot[device]:.1f}"
            table.add_row(device_label(device + 1, names[device]), f"{forecast.first_failure[device]:.0%}", slot)
    if forecast.no_failure > 1e-6:
        table.add_row("none: the UAV's battery runs out first", f"{forecast.no_failure:.0%}", "")
    return table


def advice_lines(advice: Advice, names: Sequence[str]) -> list[str]:
    """Return the lines below the tables: the next visit, the expected lifetime, and what ends it."""
    lifetimes, (low, high) = advice.forecast.lifetimes, advice.forecast.interval
    causes = ", ".join(f"{_CAUSES[cause]} {share:.0%}" for cause, share in advice.forecast.causes.items())
    return [
        f"Next: {device_label(advice.device + 1, names[advice.device])}. The network then lives "
        f"{lifetimes.mean():.1f} slots on average, {low:.0f} to {high:.0f} in 95 % of {len(lifetimes)} futures. "
        f"What ends it: {causes}."
    ]

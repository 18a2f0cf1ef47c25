"""Advice as tables for the terminal and as plain data for programs."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.planning.advice import Advice
from uavmec_jax.reporting.plan import change_table, device_label

SHOWN = 5
"""Lines of each table on the terminal; ``--json`` has all."""

_ENDS = {
    Cause.BATTERY: "a device's battery",
    Cause.DATA_AGE: "expired data",
    Cause.UAV: "the UAV's battery",
    Cause.NONE: "the time limit",
}


def advice_data(advice: Advice, names: Sequence[str]) -> dict[str, Any]:
    """Plain data: ``next``, ``ranking``, ``lifetime``, ``first_failure``, ``causes``, ``what_if``; devices by name."""
    low, high = advice.forecast.interval
    mean = float(advice.forecast.lifetimes.mean())
    return {
        "next": {"device": advice.device + 1, "name": names[advice.device]},
        "policy_says": {"device": advice.policy_choice + 1, "name": names[advice.policy_choice]},
        "ranking": [
            {
                "device": one.device + 1,
                "name": names[one.device],
                "lifetime": round(one.lifetime, 4),
                "behind": round(one.behind, 4),
                "behind_interval": [round(one.behind_low, 4), round(one.behind_high, 4)],
            }
            for one in advice.candidates
        ],
        "lifetime": {"mean": round(mean, 4), "interval": [low, high], "futures": len(advice.forecast.lifetimes)},
        "first_failure": {
            name: round(float(p), 4) for name, p in zip(names, advice.forecast.first_failure, strict=True)
        },
        "failure_slot": {
            name: round(float(slot), 2)
            for name, slot in zip(names, advice.forecast.failure_slot, strict=True)
            if np.isfinite(slot)
        },
        "no_device_fails": round(max(1.0 - float(advice.forecast.first_failure.sum()), 0.0), 4),
        "causes": {cause.name.lower(): share for cause, share in advice.forecast.causes.items()},
        "what_if": [
            {"device": one.device + 1, "name": names[one.device], "change": one.change}
            | {"lifetime": round(one.lifetime, 4), "gain": round(one.gain, 4)}
            for one in advice.what_if
        ],
    }


def advice_tables(advice: Advice, names: Sequence[str]) -> dict[str, Table]:
    """Tables by title: the next visit and its runners-up, who fails first, what repairs would bring."""
    tables = {"Visit next": _ranking(advice, names), "First to fail": _failures(advice, names)}
    if advice.what_if:
        tables["What a repair or a removal would bring now, slots"] = change_table(advice.what_if[:SHOWN], names)
    return tables


def _ranking(advice: Advice, names: Sequence[str]) -> Table:
    table = Table()
    for name in ("rank", "device", "lifetime", "behind the first", ""):
        table.add_column(name, justify="left" if name in ("device", "") else "right")
    for rank, one in enumerate(advice.candidates[:SHOWN], 1):
        half = (one.behind_high - one.behind_low) / 2
        behind = f"{one.behind:.2f} ±{half:.2f}" if rank > 1 else "-"
        own = "the policy's choice" if one.device == advice.policy_choice else ""
        table.add_row(str(rank), device_label(one.device + 1, names[one.device]), f"{one.lifetime:.2f}", behind, own)
    return table


def _failures(advice: Advice, names: Sequence[str]) -> Table:
    table = Table()
    for name in ("device", "probability", "in slot"):
        table.add_column(name, justify="left" if name == "device" else "right")
    for device in np.argsort(-advice.forecast.first_failure, kind="stable")[:SHOWN].tolist():
        if advice.forecast.first_failure[device] > 0:
            slot = f"{advice.forecast.failure_slot[device]:.1f}"
            table.add_row(device_label(device + 1, names[device]), f"{advice.forecast.first_failure[device]:.0%}", slot)
    if (nobody := 1.0 - float(advice.forecast.first_failure.sum())) > 1e-6:
        table.add_row("none: the UAV's battery runs out first", f"{nobody:.0%}", "")
    return table


def advice_lines(advice: Advice, names: Sequence[str]) -> list[str]:
    """A sentence or two below the tables."""
    low, high = advice.forecast.interval
    ends = ", ".join(f"{_ENDS[cause]} {share:.0%}" for cause, share in advice.forecast.causes.items())
    return [
        f"Next: {device_label(advice.device + 1, names[advice.device])}. The network then lives "
        f"{advice.forecast.lifetimes.mean():.1f} slots on average, {low:.0f} to {high:.0f} in 95 % of {len(advice.forecast.lifetimes)} "
        f"futures. What ends it: {ends}."
    ]

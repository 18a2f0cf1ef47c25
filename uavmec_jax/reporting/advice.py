"""Advice for the next slot as tables for the terminal and as plain data for programs."""

from typing import Any

import numpy as np
from rich.table import Table

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.planning.advice import Advice
from uavmec_jax.planning.fleet_demand import is_alone
from uavmec_jax.planning.forecast import Forecast
from uavmec_jax.reporting.changes import change_data, change_table
from uavmec_jax.reporting.fleet_advice import fleet_next_data, fleet_next_lines, fleet_next_table
from uavmec_jax.reporting.labels import device_label, duration
from uavmec_jax.scenarios.named_scenario import NamedScenario

_MAX_ROWS = 5
"""Rows of each table on the terminal; ``--json`` has all."""

_CAUSES = {
    Cause.BATTERY: "a device's battery",
    Cause.DATA_AGE: "expired data",
    Cause.UAV: "the UAV's battery",
    Cause.NONE: "the time limit",
    Cause.HORIZON: "the horizon",
    Cause.SHARE: "too many dead devices",
}


def as_in_paper(scenario: NamedScenario) -> bool:
    """Return whether there is one UAV, no depot, and the first failure is the end."""
    return is_alone(scenario.layout) and scenario.params.end == "first_failure"


def advice_data(advice: Advice, scenario: NamedScenario) -> dict[str, Any]:
    """Return the advice as plain data.

    Args:
        advice: for one state.
        scenario: it has the names and the state.

    Returns:
        ``next``, ``policy_says``, ``ranking``, or for fleets and until a horizon ``uavs``, which have them; ``lifetime``,
        ``failure_slot``, or until a horizon ``service``; ``first_failure``, ``no_device_fails``, ``causes``, ``what_if``.
        Devices are given by number (from 1) and name.
    """
    forecast, names = advice.forecast, scenario.device_names
    data = _next_data(advice, scenario) if as_in_paper(scenario) else fleet_next_data(advice, scenario)
    data |= _lifetime_data(forecast) if forecast.service_s is None else _service_data(forecast, scenario)
    data["first_failure"] = {
        name: round(float(probability), 4) for name, probability in zip(names, forecast.first_failure, strict=True)
    }
    if forecast.service_s is None:
        data["failure_slot"] = {
            name: round(float(slot), 2)
            for name, slot in zip(names, forecast.failure_slot, strict=True)
            if np.isfinite(slot)
        }
    return data | {
        "no_device_fails": round(forecast.no_failure, 4),
        "causes": {cause.name.lower(): share for cause, share in forecast.causes.items()},
        "what_if": [
            row | {name: round(row[name], 4) for name in ("lifetime", "service", "gain") if name in row}
            for row in change_data(advice.what_if, names)
        ],
    }


def _next_data(advice: Advice, scenario: NamedScenario) -> dict[str, Any]:
    """Return what the only UAV does next, as plain data."""
    names = scenario.device_names
    return {
        "next": {"device": advice.place + 1, "name": names[advice.place]},
        "policy_says": {"device": advice.policy_choice + 1, "name": names[advice.policy_choice]},
        "ranking": [
            {
                "device": candidate.place + 1,
                "name": names[candidate.place],
                "lifetime": round(candidate.lifetime, 4),
                "behind": round(candidate.behind, 4),
                "behind_interval": [round(candidate.behind_low, 4), round(candidate.behind_high, 4)],
            }
            for candidate in advice.candidates
        ],
    }


def _lifetime_data(forecast: Forecast) -> dict[str, Any]:
    mean, interval = float(forecast.lifetimes.mean()), list(forecast.interval)
    return {"lifetime": {"mean": round(mean, 4), "interval": interval, "futures": len(forecast.lifetimes)}}


def _service_data(forecast: Forecast, scenario: NamedScenario) -> dict[str, Any]:
    """Return the share of the time left to the horizon in which the devices are in service."""
    mean, low, high = _service_shares(forecast, scenario)
    interval = [round(low, 4), round(high, 4)]
    service = {"mean": round(mean, 4), "interval": interval, "futures": len(forecast.lifetimes)}
    return {"seconds_left": _seconds_left(scenario), "service": service}


def _seconds_left(scenario: NamedScenario) -> float:
    return max(float(scenario.params.horizon_s) - float(scenario.state.elapsed), 1.0)


def _service_shares(forecast: Forecast, scenario: NamedScenario) -> tuple[float, float, float]:
    """Return mean, low and high end of the share of the time left in which the devices are in service."""
    assert forecast.service_s is not None
    assert forecast.service_interval is not None
    left = _seconds_left(scenario)
    low, high = forecast.service_interval
    return float(forecast.service_s.mean()) / left, low / left, high / left


def advice_tables(advice: Advice, scenario: NamedScenario) -> dict[str, Table]:
    """Return tables by title: the next visit and its alternatives, the first failure, and the gains of repairs."""
    if as_in_paper(scenario):
        tables = {"Visit next": _ranking_table(advice, scenario)}
    else:
        tables = {"Where each UAV goes next": fleet_next_table(advice, scenario)}
    tables["First to fail"] = _failure_table(advice, scenario)
    if advice.what_if:
        unit = "slots" if advice.forecast.service_s is None else "share of the time left in service"
        title = f"What a repair or a removal would bring now, {unit}"
        tables[title] = change_table(advice.what_if[:_MAX_ROWS], scenario.device_names)
    return tables


def _ranking_table(advice: Advice, scenario: NamedScenario) -> Table:
    table, names = Table(), scenario.device_names
    for column in ("rank", "device", "lifetime", "behind the first", ""):
        table.add_column(column, justify="left" if column in ("device", "") else "right")
    for rank, candidate in enumerate(advice.candidates[:_MAX_ROWS], 1):
        half = (candidate.behind_high - candidate.behind_low) / 2
        behind = f"{candidate.behind:.2f} ±{half:.2f}" if rank > 1 else "-"
        note = "the policy's choice" if candidate.place == advice.policy_choice else ""
        label = device_label(candidate.place + 1, names[candidate.place])
        table.add_row(str(rank), label, f"{candidate.lifetime:.2f}", behind, note)
    return table


def _failure_table(advice: Advice, scenario: NamedScenario) -> Table:
    forecast, table, names = advice.forecast, Table(), scenario.device_names
    known = forecast.service_s is None
    for column in ("device", "probability", *["in slot"] * known):
        table.add_column(column, justify="left" if column == "device" else "right")
    for device in np.argsort(-forecast.first_failure, kind="stable")[:_MAX_ROWS].tolist():
        if forecast.first_failure[device] > 0:
            slot = [f"{forecast.failure_slot[device]:.1f}"] * known
            table.add_row(device_label(device + 1, names[device]), f"{forecast.first_failure[device]:.0%}", *slot)
    if forecast.no_failure > 1e-6:
        none = "none: the UAV's battery runs out first" if as_in_paper(scenario) else "none"
        table.add_row(none, f"{forecast.no_failure:.0%}", *[""] * known)
    return table


def advice_lines(advice: Advice, scenario: NamedScenario) -> list[str]:
    """Return the lines below the tables: the next visits, the expected lifetime or service, and what ends it."""
    forecast, words = advice.forecast, _CAUSES
    if as_in_paper(scenario):
        label = device_label(advice.place + 1, scenario.device_names[advice.place])
        return [f"Next: {label}. {_lifetime_line(forecast, words)}"]
    words = words | {Cause.UAV: "the UAVs' batteries"}
    lines = fleet_next_lines(advice, scenario)
    if forecast.service_s is None:
        return [*lines, _lifetime_line(forecast, words)]
    mean, low, high = _service_shares(forecast, scenario)
    return [
        *lines,
        f"The devices are then in service for {mean:.1%} of the {duration(_seconds_left(scenario))} left to the horizon, "
        f"{low:.1%} to {high:.1%} in 95 % of {len(forecast.lifetimes)} futures.",
    ]


def _lifetime_line(forecast: Forecast, words: dict[Cause, str]) -> str:
    lifetimes, (low, high) = forecast.lifetimes, forecast.interval
    causes = ", ".join(f"{words[cause]} {share:.0%}" for cause, share in forecast.causes.items())
    at_least = "at least " if forecast.causes.get(Cause.NONE) else ""  # futures that the time limit ends
    return (
        f"The network then lives {at_least}{lifetimes.mean():.1f} slots on average, {low:.0f} to {high:.0f} in 95 % of "
        f"{len(lifetimes)} futures. What ends it: {causes}."
    )

"""The plan of one scenario as tables for the terminal, as plain data for programs, and as files."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.env.rollout import Trace
from uavmec_jax.files.writing import write_text
from uavmec_jax.planning.changes import WhatIf
from uavmec_jax.planning.plan import Plan
from uavmec_jax.reporting import canvas
from uavmec_jax.reporting.geojson import tour_geojson
from uavmec_jax.reporting.tables import display_name
from uavmec_jax.reporting.tour_figure import tour_figure
from uavmec_jax.runs.folder import TOUR
from uavmec_jax.scenarios.named_scenario import NamedScenario
from uavmec_jax.scenarios.scenario_files import scenario_text
from uavmec_jax.training import host

_CAUSES = {
    Cause.BATTERY: "its battery runs out",
    Cause.DATA_AGE: "its data expire",
    Cause.UAV: "the UAV's battery runs out",
    Cause.NONE: "the time limit ends it",
}
_TOUR_TITLES = {
    "rollout": "The rollout planner's tour (knows no volumes in advance), first draw",
    "beam": "The beam's tour (clairvoyant: knows every volume in advance), first draw",
}


def plan_tables(plan: Plan, names: Sequence[str]) -> dict[str, Table]:
    """Return tables by title: lifetimes, the tours slot by slot, and the gains of repairs and removals.

    Args:
        plan: of one scenario.
        names: of the devices.
    """
    return {
        f"Lifetime in slots, mean over {len(plan.bound)} volume draws": _lifetime_table(plan),
        **{_TOUR_TITLES[name]: _tour_table(plan, names, tour) for name, tour in plan.tours.items()},
        "What a repair or a removal would bring, slots": change_table(plan.what_if, names),
    }


def _lifetime_table(plan: Plan) -> Table:
    """One row per policy, the shortest mean lifetime first, and the upper bound last."""
    table = Table()
    for column in ("policy", "slots", "least", "most"):
        table.add_column(column, justify="left" if column == "policy" else "right")
    ladder = {**dict(sorted(plan.lifetimes.items(), key=lambda item: item[1].mean())), "bound": plan.bound}
    for policy, lifetimes in ladder.items():
        table.add_row(display_name(policy), f"{lifetimes.mean():.2f}", str(lifetimes.min()), str(lifetimes.max()))
    return table


def _tour_table(plan: Plan, names: Sequence[str], tour: Trace) -> Table:
    table = Table()
    for column in ("slot", "visit", "flight\nm", "served", "length\ns", "UAV\nkJ", "lowest\nbattery", "oldest\ndata"):
        justify: Any = "left" if column in ("visit", "served") else "right"
        table.add_column(column, justify=justify, no_wrap=column != "served")
    for row in slot_rows(plan, names, tour):
        battery, data = row["lowest_battery"], row["oldest_data"]
        table.add_row(
            str(row["slot"]),
            device_label(row["device"], row["name"]),
            f"{row['flight_m']:.0f}",
            " ".join(f"#{device}" for device in row["served"]),
            f"{row['duration_s']:.0f}",
            f"{row['uav_energy_j'] / 1e3:.0f}",
            f"#{battery['device']} {battery['fraction']:.0%}",
            f"#{data['device']} {data['slots']}" if data["slots"] else "-",
        )
    return table


def slot_rows(plan: Plan, names: Sequence[str], tour: Trace) -> list[dict[str, Any]]:
    """Return one plain dictionary per slot of a tour; devices are numbered from 1."""
    position = plan.layout.position[tour.action]
    flights = np.linalg.norm(np.diff(position, axis=0, prepend=np.zeros((1, 2))), axis=1)
    fraction = tour.state.battery / plan.layout.capacity
    return [
        {
            "slot": slot + 1,
            "device": int(action) + 1,
            "name": names[int(action)],
            "flight_m": float(flights[slot]),
            "served": [int(device) + 1 for device in np.flatnonzero(tour.outcome.served[slot])],
            "duration_s": float(tour.outcome.duration[slot]),
            "uav_energy_j": float(tour.state.uav_energy[slot, 0]),
            "lowest_battery": {
                "device": int(fraction[slot].argmin()) + 1,
                "fraction": float(fraction[slot].min()),
            },
            "oldest_data": {
                "device": int(tour.state.age[slot].argmax()) + 1,
                "slots": int(tour.state.age[slot].max()),
            },
        }
        for slot, action in enumerate(tour.action)
    ]


def device_label(number: int, name: str) -> str:
    """Return number and name of a device; the number alone if the name repeats it."""
    return f"#{number}" if name == f"device {number}" else f"#{number} {name}"


def change_table(changes: Sequence[WhatIf], names: Sequence[str]) -> Table:
    """Return a table of repairs and removals, the largest gain first."""
    table = Table()
    for column in ("rank", "device", "change", "lifetime", "gain"):
        table.add_column(column, justify="left" if column in ("device", "change") else "right")
    for rank, row in enumerate(change_data(changes, names), 1):
        label = device_label(row["device"], row["name"])
        table.add_row(str(rank), label, row["change"], f"{row['lifetime']:.2f}", f"{row['gain']:+.2f}")
    return table


def change_data(changes: Sequence[WhatIf], names: Sequence[str]) -> list[dict[str, Any]]:
    """Return repairs and removals as plain data; devices are numbered from 1."""
    return [
        {
            "device": change.device + 1,
            "name": names[change.device],
            "change": change.change,
            "lifetime": change.lifetime,
            "gain": change.gain,
        }
        for change in changes
    ]


def plan_summary(plan: Plan, names: Sequence[str]) -> list[str]:
    """Return the lines below the tables: what fails first and why, and how far the tours are from the upper bound."""
    rollout, beam, bound = (
        float(lifetimes.mean()) for lifetimes in (plan.lifetimes["rollout"], plan.lifetimes["beam"], plan.bound)
    )
    first = first_failing(plan, names)
    cause = _CAUSES[Cause[first["cause"].upper()]]
    if first["device"] is None:
        failure = f"No device fails first: {cause}."
    else:
        label = device_label(first["device"], first["name"])
        failure = f"First to fail: {label}, in {first['share']:.0%} of the draws; {cause}."
    return [
        failure,
        f"Rollout planner {rollout:.2f} slots; knowing the volumes would add {100 * (beam / rollout - 1):.1f} % "
        f"(beam {beam:.2f}); the upper bound is {bound:.2f} (within {100 * (bound / beam - 1):.1f} % of the beam).",
    ]


def first_failing(plan: Plan, names: Sequence[str]) -> dict[str, Any]:
    """Return the device that fails first most often under the rollout planner, and why; ``None`` if no device fails."""
    share, causes = plan.forecast.first_failure, plan.forecast.causes
    if share.max() <= 0:
        cause = max(causes, key=lambda cause: causes[cause])
        return {"device": None, "name": None, "share": 0.0, "cause": cause.name.lower()}
    device = int(share.argmax())
    failures = {cause: often for cause, often in causes.items() if cause in (Cause.BATTERY, Cause.DATA_AGE)}
    cause = max(failures, key=lambda cause: failures[cause])
    return {
        "device": device + 1,
        "name": names[device],
        "share": float(share[device]),
        "cause": cause.name.lower(),
    }


def plan_data(plan: Plan, names: Sequence[str], scenario: str) -> dict[str, Any]:
    """Return the plan as plain data, devices numbered from 1; ``uavmec plan --json`` prints it.

    Args:
        plan: of one scenario.
        names: of the devices.
        scenario: its name.
    """
    return {
        "scenario": scenario,
        "draws": len(plan.bound),
        "policies": {name: float(lifetimes.mean()) for name, lifetimes in plan.lifetimes.items()},
        "bound": float(plan.bound.mean()),
        "tour": {name: [int(action) + 1 for action in tour.action] for name, tour in plan.tours.items()},
        "slots": {name: slot_rows(plan, names, tour) for name, tour in plan.tours.items()},
        "first_failing": first_failing(plan, names),
        "first_failure_share": {
            name: float(share) for name, share in zip(names, plan.forecast.first_failure, strict=True)
        },
        "what_if": change_data(plan.what_if, names),
    }


def save_plan(plan: Plan, scenario: NamedScenario, directory: Path, command: str) -> None:
    """Write ``tour.json``, ``tour.png``, ``scenario.toml`` and, if the scenario has geographic positions, ``tour.geojson``.

    Args:
        plan: of the scenario.
        scenario: what was planned for.
        directory: made if it does not exist.
        command: the command line, for the label.
    """
    directory.mkdir(parents=True, exist_ok=True)
    names = scenario.device_names
    texts = {
        "scenario.toml": scenario_text(scenario),
        TOUR: _json(plan_data(plan, names, scenario.name) | {"command": command, **host.describe()}),
    }
    if scenario.origin is not None:
        texts["tour.geojson"] = _json(tour_geojson(scenario, plan))
    canvas.save(tour_figure(plan, names, scenario.name), directory / "tour.png")
    for name, text in texts.items():
        write_text(directory / name, text)


def _json(data: dict[str, Any]) -> str:
    return json.dumps(data, indent=1, allow_nan=False) + "\n"

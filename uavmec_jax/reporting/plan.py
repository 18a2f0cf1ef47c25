"""The plan of one scenario as tables for the terminal and as plain data for programs."""

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

CAUSES = {
    Cause.BATTERY: "its battery runs out",
    Cause.DATA_AGE: "its data expire",
    Cause.UAV: "the UAV's battery runs out",
    Cause.NONE: "the time limit ends it",
}


def plan_tables(plan: Plan, names: Sequence[str]) -> dict[str, Table]:
    """Tables by title: lifetimes, the two tours slot by slot, what repairs would bring."""
    draws = len(plan.bound)
    titles = {
        "rollout": "The rollout planner's tour (knows no volumes in advance), first draw",
        "beam": "The beam's tour (clairvoyant: knows every volume in advance), first draw",
    }
    tours = {titles[name]: _tour_table(plan, names, tour) for name, tour in plan.tours.items()}
    lives = {f"Lifetime in slots, mean over {draws} volume draws": _lifetime_table(plan)}
    return lives | tours | {"What a repair or a removal would bring, slots": change_table(plan.what_if, names)}


def _lifetime_table(plan: Plan) -> Table:
    table = Table()
    for name in ("policy", "slots", "least", "most"):
        table.add_column(name, justify="left" if name == "policy" else "right")
    ladder = {**dict(sorted(plan.lifetimes.items(), key=lambda item: item[1].mean())), "bound": plan.bound}
    for name, lives in ladder.items():
        table.add_row(display_name(name), f"{lives.mean():.2f}", str(lives.min()), str(lives.max()))
    return table


def _tour_table(plan: Plan, names: Sequence[str], tour: Trace) -> Table:
    table = Table()
    for name in ("slot", "visit", "flight\nm", "served", "length\ns", "UAV\nkJ", "lowest\nbattery", "oldest\ndata"):
        table.add_column(name, justify="left" if name in ("visit", "served") else "right", no_wrap=name != "served")
    for row in slot_rows(plan, names, tour):
        low, old = row["lowest_battery"], row["oldest_data"]
        table.add_row(
            str(row["slot"]),
            device_label(row["device"], row["name"]),
            f"{row['flight_m']:.0f}",
            " ".join(f"#{device}" for device in row["served"]),
            f"{row['duration_s']:.0f}",
            f"{row['uav_energy_j'] / 1e3:.0f}",
            f"#{low['device']} {low['fraction']:.0%}",
            f"#{old['device']} {old['slots']}" if old["slots"] else "-",
        )
    return table


def slot_rows(plan: Plan, names: Sequence[str], tour: Trace) -> list[dict[str, Any]]:
    """One plain dictionary per slot of a tour; devices are numbered from 1."""
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
            "uav_energy_j": float(tour.state.uav_energy[slot]),
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
    """Number and name, unless the name says no more than the number."""
    return f"#{number}" if name == f"device {number}" else f"#{number} {name}"


def change_table(changes: Sequence[WhatIf], names: Sequence[str]) -> Table:
    """Repairs and removals, the most useful first."""
    table = Table()
    for name in ("rank", "device", "change", "lifetime", "gain"):
        table.add_column(name, justify="left" if name in ("device", "change") else "right")
    for rank, one in enumerate(changes, 1):
        table.add_row(
            str(rank),
            device_label(one.device + 1, names[one.device]),
            one.change,
            f"{one.lifetime:.2f}",
            f"{one.gain:+.2f}",
        )
    return table


def plan_summary(plan: Plan, names: Sequence[str]) -> list[str]:
    """What fails first and why, and how far the tours are from the best possible."""
    rollout, beam, bound = (
        float(lives.mean()) for lives in (plan.lifetimes["rollout"], plan.lifetimes["beam"], plan.bound)
    )
    first = first_failing(plan, names)
    if first["device"] is None:
        lines = [f"No device fails first: {CAUSES[Cause[first['cause'].upper()]]}."]
    else:
        who = device_label(first["device"], first["name"])
        lines = [
            f"First to fail: {who}, in {first['share']:.0%} of the draws; {CAUSES[Cause[first['cause'].upper()]]}."
        ]
    return [
        *lines,
        f"Rollout planner {rollout:.2f} slots; knowing the volumes would add {100 * (beam / rollout - 1):.1f} % "
        f"(beam {beam:.2f}); the upper bound is {bound:.2f} (within {100 * (bound / beam - 1):.1f} % of the beam).",
    ]


def first_failing(plan: Plan, names: Sequence[str]) -> dict[str, Any]:
    """The device that fails first most often under the rollout planner, and why; device ``None`` if none does."""
    share, cause = plan.forecast.first_failure, max(plan.forecast.causes, key=lambda cause: plan.forecast.causes[cause])
    if share.max() <= 0:
        return {"device": None, "name": None, "share": 0.0, "cause": cause.name.lower()}
    device = int(share.argmax())
    own = {cause: often for cause, often in plan.forecast.causes.items() if cause in (Cause.BATTERY, Cause.DATA_AGE)}
    return {
        "device": device + 1,
        "name": names[device],
        "share": float(share[device]),
        "cause": max(own, key=lambda cause: own[cause]).name.lower(),
    }


def plan_data(plan: Plan, names: Sequence[str], scenario: str) -> dict[str, Any]:
    """The plan as plain data, devices numbered from 1; what ``uavmec plan --json`` prints."""
    return {
        "scenario": scenario,
        "draws": len(plan.bound),
        "policies": {name: float(lives.mean()) for name, lives in plan.lifetimes.items()},
        "bound": float(plan.bound.mean()),
        "tour": {name: [int(a) + 1 for a in tour.action] for name, tour in plan.tours.items()},
        "slots": {name: slot_rows(plan, names, tour) for name, tour in plan.tours.items()},
        "first_failing": first_failing(plan, names),
        "first_failure_share": {
            name: float(often) for name, often in zip(names, plan.forecast.first_failure, strict=True)
        },
        "what_if": [
            {
                "device": one.device + 1,
                "name": names[one.device],
                "change": one.change,
                "lifetime": one.lifetime,
                "gain": one.gain,
            }
            for one in plan.what_if
        ],
    }


def save_plan(plan: Plan, scenario: NamedScenario, directory: Path, command: str) -> None:
    """Write ``tour.json``, ``tour.png``, ``scenario.toml`` and, if the devices are on the map, ``tour.geojson``."""
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

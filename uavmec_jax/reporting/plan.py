"""The outlook of one scenario as tables for the terminal and as plain data for programs."""

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
from uavmec_jax.planning.plan import Outlook
from uavmec_jax.reporting import canvas
from uavmec_jax.reporting.geojson import plan_geojson
from uavmec_jax.reporting.tables import spoken
from uavmec_jax.reporting.tour_figure import route_figure
from uavmec_jax.scenarios.named_scenario import Inventory
from uavmec_jax.scenarios.scenario_files import inventory_text
from uavmec_jax.training import host

CAUSES = {
    Cause.BATTERY: "its battery runs out",
    Cause.DATA_AGE: "its data expire",
    Cause.UAV: "the UAV's battery runs out",
    Cause.NONE: "the time limit ends it",
}


def outlook_tables(outlook: Outlook, names: Sequence[str]) -> dict[str, Table]:
    """Tables by title: lifetimes, the two tours slot by slot, what repairs would bring."""
    draws = len(outlook.bound)
    titles = {
        "rollout": "The rollout planner's tour (knows no volumes in advance), first draw",
        "beam": "The beam's tour (clairvoyant: knows every volume in advance), first draw",
    }
    tours = {titles[name]: _tour_table(outlook, names, route) for name, route in outlook.routes.items()}
    lives = {f"Lifetime in slots, mean over {draws} volume draws": _lifetime_table(outlook)}
    return lives | tours | {"What a repair or a removal would bring, slots": change_table(outlook.what_if, names)}


def _lifetime_table(outlook: Outlook) -> Table:
    table = Table()
    for name in ("policy", "slots", "least", "most"):
        table.add_column(name, justify="left" if name == "policy" else "right")
    ladder = {**dict(sorted(outlook.lifetimes.items(), key=lambda item: item[1].mean())), "bound": outlook.bound}
    for name, lives in ladder.items():
        table.add_row(spoken(name), f"{lives.mean():.2f}", str(lives.min()), str(lives.max()))
    return table


def _tour_table(outlook: Outlook, names: Sequence[str], route: Trace) -> Table:
    table = Table()
    for name in ("slot", "visit", "flight\nm", "served", "length\ns", "UAV\nkJ", "lowest\nbattery", "oldest\ndata"):
        table.add_column(name, justify="left" if name in ("visit", "served") else "right", no_wrap=name != "served")
    for row in slot_rows(outlook, names, route):
        low, old = row["lowest_battery"], row["oldest_data"]
        table.add_row(
            str(row["slot"]),
            called(row["device"], row["name"]),
            f"{row['flight_m']:.0f}",
            " ".join(f"#{device}" for device in row["served"]),
            f"{row['duration_s']:.0f}",
            f"{row['uav_energy_j'] / 1e3:.0f}",
            f"#{low['device']} {low['fraction']:.0%}",
            f"#{old['device']} {old['slots']}" if old["slots"] else "-",
        )
    return table


def slot_rows(outlook: Outlook, names: Sequence[str], route: Trace) -> list[dict[str, Any]]:
    """One plain dictionary per slot of a route; devices are numbered from 1."""
    position = outlook.layout.position[route.action]
    flights = np.linalg.norm(np.diff(position, axis=0, prepend=np.zeros((1, 2))), axis=1)
    fraction = route.state.battery / outlook.layout.capacity
    return [
        {
            "slot": slot + 1,
            "device": int(action) + 1,
            "name": names[int(action)],
            "flight_m": float(flights[slot]),
            "served": [int(device) + 1 for device in np.flatnonzero(route.outcome.served[slot])],
            "duration_s": float(route.outcome.duration[slot]),
            "uav_energy_j": float(route.state.uav_energy[slot]),
            "lowest_battery": {
                "device": int(fraction[slot].argmin()) + 1,
                "fraction": float(fraction[slot].min()),
            },
            "oldest_data": {
                "device": int(route.state.age[slot].argmax()) + 1,
                "slots": int(route.state.age[slot].max()),
            },
        }
        for slot, action in enumerate(route.action)
    ]


def called(number: int, name: str) -> str:
    """Number and name, unless the name says no more than the number."""
    return f"#{number}" if name == f"device {number}" else f"#{number} {name}"


def change_table(changes: Sequence[WhatIf], names: Sequence[str]) -> Table:
    """Repairs and removals, the most useful first."""
    table = Table()
    for name in ("rank", "device", "change", "lifetime", "gain"):
        table.add_column(name, justify="left" if name in ("device", "change") else "right")
    for rank, one in enumerate(changes, 1):
        table.add_row(
            str(rank), called(one.device + 1, names[one.device]), one.change, f"{one.lifetime:.2f}", f"{one.gain:+.2f}"
        )
    return table


def outlook_summary(outlook: Outlook, names: Sequence[str]) -> list[str]:
    """What fails first and why, and how far the tours are from the best possible."""
    rollout, beam, bound = (
        float(lives.mean()) for lives in (outlook.lifetimes["rollout"], outlook.lifetimes["beam"], outlook.bound)
    )
    first = first_failing(outlook, names)
    if first["device"] is None:
        lines = [f"No device fails first: {CAUSES[Cause[first['cause'].upper()]]}."]
    else:
        who = called(first["device"], first["name"])
        lines = [
            f"First to fail: {who}, in {first['share']:.0%} of the draws; {CAUSES[Cause[first['cause'].upper()]]}."
        ]
    return [
        *lines,
        f"Rollout planner {rollout:.2f} slots; knowing the volumes would add {100 * (beam / rollout - 1):.1f} % "
        f"(beam {beam:.2f}); nobody passes {bound:.2f} (within {100 * (bound / beam - 1):.1f} % of the beam).",
    ]


def first_failing(outlook: Outlook, names: Sequence[str]) -> dict[str, Any]:
    """The device that fails first most often under the rollout planner, and why; device ``None`` if none does."""
    share, cause = outlook.first_failure, max(outlook.causes, key=lambda cause: outlook.causes[cause])
    if share.max() <= 0:
        return {"device": None, "name": None, "share": 0.0, "cause": cause.name.lower()}
    device = int(share.argmax())
    own = {cause: often for cause, often in outlook.causes.items() if cause in (Cause.BATTERY, Cause.DATA_AGE)}
    return {
        "device": device + 1,
        "name": names[device],
        "share": float(share[device]),
        "cause": max(own, key=lambda cause: own[cause]).name.lower(),
    }


def outlook_data(outlook: Outlook, names: Sequence[str], scenario: str) -> dict[str, Any]:
    """The outlook as plain data, devices numbered from 1; what ``uavmec plan --json`` prints."""
    return {
        "scenario": scenario,
        "draws": len(outlook.bound),
        "policies": {name: float(lives.mean()) for name, lives in outlook.lifetimes.items()},
        "bound": float(outlook.bound.mean()),
        "route": {name: [int(a) + 1 for a in route.action] for name, route in outlook.routes.items()},
        "slots": {name: slot_rows(outlook, names, route) for name, route in outlook.routes.items()},
        "first_failing": first_failing(outlook, names),
        "first_failure_share": {name: float(often) for name, often in zip(names, outlook.first_failure, strict=True)},
        "what_if": [
            {
                "device": one.device + 1,
                "name": names[one.device],
                "change": one.change,
                "lifetime": one.lifetime,
                "gain": one.gain,
            }
            for one in outlook.what_if
        ],
    }


def save_outlook(outlook: Outlook, inventory: Inventory, directory: Path, command: str) -> None:
    """Write ``plan.json``, ``plan.png``, ``layout.toml`` and, if the devices have a place on the map, ``plan.geojson``."""
    directory.mkdir(parents=True, exist_ok=True)
    names, scenario = inventory.names, inventory.file.name
    texts = {
        "layout.toml": inventory_text(inventory),
        "plan.json": _json(outlook_data(outlook, names, scenario) | {"command": command, **host.describe()}),
    }
    if inventory.origin is not None:
        texts["plan.geojson"] = _json(plan_geojson(inventory, outlook))
    canvas.save(route_figure(outlook, names, scenario), directory / "plan.png")
    for name, text in texts.items():
        write_text(directory / name, text)


def _json(data: dict[str, Any]) -> str:
    return json.dumps(data, indent=1, allow_nan=False) + "\n"

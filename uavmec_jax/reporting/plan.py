"""The plan of one scenario as tables for the terminal, as plain data for programs, and as files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.files.writing import write_text
from uavmec_jax.planning.plan import Plan
from uavmec_jax.reporting import canvas
from uavmec_jax.reporting.changes import change_data, change_table
from uavmec_jax.reporting.fleet_tours import device_rows, device_table, fleet_rows, fleet_table, hidden_uavs
from uavmec_jax.reporting.geojson import tour_geojson
from uavmec_jax.reporting.labels import device_label, duration, place_label
from uavmec_jax.reporting.service import (
    lifetime_table,
    measure_data,
    measure_table,
    most_common_first_cause,
    service_table,
)
from uavmec_jax.reporting.tour_figure import tour_figure
from uavmec_jax.reporting.tours import slot_rows, tour_table
from uavmec_jax.runs.file_names import TOUR
from uavmec_jax.scenarios.named_scenario import NamedScenario
from uavmec_jax.scenarios.scenario_files import scenario_text
from uavmec_jax.training import host

_CAUSES = {
    Cause.BATTERY: "its battery runs out",
    Cause.DATA_AGE: "its data expire",
    Cause.UAV: "the UAV's battery runs out",
    Cause.NONE: "the time limit ends it",
    Cause.HORIZON: "the time is over",
    Cause.SHARE: "too many devices are dead",
}
_TOUR_TITLES = {
    "rollout": "The rollout planner's tour (knows no volumes in advance), first draw",
    "beam": "The beam's tour (clairvoyant: knows every volume in advance), first draw",
}


def plan_tables(plan: Plan, scenario: NamedScenario) -> dict[str, Table]:
    """Return tables by title: lifetimes or service, the tours slot by slot, and the gains of repairs and removals.

    Args:
        plan: of one scenario.
        scenario: it has the names.
    """
    names, draws = scenario.device_names, f"mean over {_draws(plan)} volume draws"
    if plan.as_in_paper:
        tours = {_TOUR_TITLES[name]: tour_table(plan, names, tour) for name, tour in plan.tours.items()}
    else:
        tours = {_TOUR_TITLES[name]: fleet_table(rows, scenario) for name, rows in _fleet_rows(plan, scenario).items()}
    changes = change_table(plan.what_if, names)
    if plan.service is None or plan.service_bound is None:
        lifetimes = {f"Lifetime in slots, {draws}": lifetime_table(plan)}
        if plan.as_in_paper:
            return lifetimes | tours | {"What a repair or a removal would bring, slots": changes}
        measures = {f"Measures of the rollout planner's tours, {draws}": _measure_table(plan, scenario)}
        rule = "What a repair or a removal would bring under the earliest-deadline rule, slots"
        return lifetimes | tours | measures | {rule: changes}
    rows = device_rows(plan.params, plan.layout, plan.tours["rollout"])
    return {
        f"Share of the {_time(plan)} in which devices are in service, {draws}": service_table(
            plan.service, plan.service_bound
        ),
        **tours,
        "Devices under the rollout planner, first draw": device_table(
            rows, names, plan.forecast.first_failure.tolist()
        ),
        f"Measures of the rollout planner's tours, {draws}": _measure_table(plan, scenario),
        "What a repair or a removal would bring under the earliest-deadline rule": changes,
    }


def _draws(plan: Plan) -> int:
    return len(plan.lifetimes["rollout"])


def _time(plan: Plan) -> str:
    return duration(float(plan.params.horizon_s))


def _measure_table(plan: Plan, scenario: NamedScenario) -> Table:
    return measure_table(plan.measures, depots=bool(scenario.depot_names))


def _fleet_rows(plan: Plan, scenario: NamedScenario) -> dict[str, list[dict[str, Any]]]:
    return {name: fleet_rows(plan.params, plan.layout, scenario, tour) for name, tour in plan.tours.items()}


def plan_summary(plan: Plan, scenario: NamedScenario) -> list[str]:
    """Return the lines below the tables: what fails first and why, and how far the tours are from the upper bound."""
    lines = [_failure_line(plan, scenario), *(_gap_lines(plan) if plan.service is None else _service_lines(plan))]
    if scenario.depot_names:
        devices = len(scenario.device_names)
        labels = [place_label(scenario, devices + depot) for depot in range(len(scenario.depot_names))]
        lines.append(f"Depots: {', '.join(labels)}.")
    if hidden := hidden_uavs(scenario):
        lines.append(f"{hidden} more UAV{'s are' if hidden > 1 else ' is'} in tour.json and --json.")
    return lines


def _failure_line(plan: Plan, scenario: NamedScenario) -> str:
    first, cause = first_failing(plan, scenario), ""
    if first["cause"] is not None:
        cause = _CAUSES[Cause[first["cause"].upper()]]
        if first["cause"] == "uav" and not plan.as_in_paper:
            cause = "no UAV can go on"
    if first["device"] is None:
        return f"No device fails first: {cause}."
    label = device_label(first["device"], first["name"])
    return f"First to fail: {label}, in {first['share']:.0%} of the draws; {cause}."


def _gap_lines(plan: Plan) -> list[str]:
    assert plan.bound is not None
    lifetimes, limit = plan.lifetimes, int(plan.params.max_slots)
    rollout, beam, bound = (float(slots.mean()) for slots in (lifetimes["rollout"], lifetimes["beam"], plan.bound))
    best, longest = max(rollout, beam), np.maximum(lifetimes["rollout"], lifetimes["beam"])
    if reached := int((longest >= limit).sum()):
        return [
            f"Rollout planner {rollout:.2f} slots, beam {beam:.2f}, or more: in {reached} of {_draws(plan)} draws the "
            f"network is alive after {limit} slots, where planning ends, and lives at least that long.",
            "To plan for longer, give max_slots, in [params] or as --set max_slots=200.",
        ]
    if plan.bound.max() >= limit:
        return [
            f"Rollout planner {rollout:.2f} slots; the beam, which knows the volumes, {beam:.2f}; no upper bound below "
            f"max_slots, {limit}, is proved for all draws."
        ]
    if plan.as_in_paper:
        return [
            f"Rollout planner {rollout:.2f} slots; knowing the volumes would add {100 * (beam / rollout - 1):.1f} % "
            f"(beam {beam:.2f}); the upper bound is {bound:.2f} (within {100 * (bound / beam - 1):.1f} % of the beam)."
        ]
    return [
        f"Rollout planner {rollout:.2f} slots; the beam, which knows the volumes, {beam:.2f}; the upper bound is "
        f"{bound:.2f} (within {100 * (bound / best - 1):.1f} % of the better one)."
    ]


def _service_lines(plan: Plan) -> list[str]:
    assert plan.service is not None
    assert plan.service_bound is not None
    rollout = float(plan.service["rollout"].mean())
    lines = [
        f"Under the rollout planner, the devices are in service for {rollout:.1%} of the {_time(plan)}. No policy reaches "
        f"more than {plan.service_bound:.1%}: no device without power works longer than its battery lasts in standby.",
        f"A point, one hundredth of that time, is {duration(float(plan.params.horizon_s) / 100)} of service of every device.",
    ]
    if cut := round(_draws(plan) * plan.forecast.causes.get(Cause.NONE, 0.0)):
        lines.append(
            f"In {cut} of {_draws(plan)} draws planning ends after {int(plan.params.max_slots)} slots, before the time is "
            "over; what comes then does not count. Give a larger max_slots."
        )
    return lines


def first_failing(plan: Plan, scenario: NamedScenario) -> dict[str, Any]:
    """Return the device that fails first most often under the rollout planner, and why; ``None`` if no device fails."""
    share, causes = plan.forecast.first_failure, plan.forecast.causes
    if share.max() <= 0:
        cause = max(causes, key=lambda cause: causes[cause])
        return {"device": None, "name": None, "share": 0.0, "cause": cause.name.lower()}
    device = int(share.argmax())
    failures = {cause: often for cause, often in causes.items() if cause in (Cause.BATTERY, Cause.DATA_AGE)}
    cause = max(failures, key=lambda cause: failures[cause]) if failures else most_common_first_cause(plan.measures)
    return {
        "device": device + 1,
        "name": scenario.device_names[device],
        "share": float(share[device]),
        "cause": cause.name.lower(),
    }


def plan_data(plan: Plan, scenario: NamedScenario) -> dict[str, Any]:
    """Return the plan as plain data, devices numbered from 1; ``uavmec plan --json`` prints it.

    Args:
        plan: of one scenario.
        scenario: it has the names.
    """
    names = scenario.device_names
    data: dict[str, Any] = {"scenario": scenario.name, "draws": _draws(plan)}
    if not plan.as_in_paper:
        data |= {"uavs": scenario.uav_names, "places": scenario.place_names, "max_slots": int(plan.params.max_slots)}
    if plan.service is None or plan.service_bound is None:
        data |= _lifetime_data(plan)
    else:
        data |= {
            "horizon_s": float(plan.params.horizon_s),
            "service": {name: float(share.mean()) for name, share in plan.service.items()},
            "service_bound": plan.service_bound,
        }
    data["tour"] = {name: (tour.action + 1).tolist() for name, tour in plan.tours.items()}
    if plan.as_in_paper:
        data["slots"] = {name: slot_rows(plan, names, tour) for name, tour in plan.tours.items()}
    else:
        data["slots"] = _fleet_rows(plan, scenario)
    data["first_failing"] = first_failing(plan, scenario)
    data["first_failure_share"] = {
        name: float(share) for name, share in zip(names, plan.forecast.first_failure, strict=True)
    }
    if not plan.as_in_paper:
        data["measures"] = measure_data(plan.measures)
    if plan.service is not None:
        rows = device_rows(plan.params, plan.layout, plan.tours["rollout"])
        data["device_service"] = [{"name": name} | row for name, row in zip(names, rows, strict=True)]
    return data | {"what_if": change_data(plan.what_if, names)}


def _lifetime_data(plan: Plan) -> dict[str, Any]:
    """Return mean lifetimes and bound; for fleets, also the share of the draws in which they reach ``max_slots``."""
    assert plan.bound is not None
    data: dict[str, Any] = {
        "policies": {name: float(lifetimes.mean()) for name, lifetimes in plan.lifetimes.items()},
        "bound": float(plan.bound.mean()),
    }
    if not plan.as_in_paper:
        limit = int(plan.params.max_slots)
        reached = {name: float((lifetimes >= limit).mean()) for name, lifetimes in plan.lifetimes.items()}
        data["censored"] = reached | {"bound": float((plan.bound >= limit).mean())}
    return data


def save_plan(plan: Plan, scenario: NamedScenario, directory: Path, command: str) -> None:
    """Write ``tour.json``, ``tour.png``, ``scenario.toml`` and, if the scenario has geographic positions, ``tour.geojson``.

    Args:
        plan: of the scenario.
        scenario: what was planned for.
        directory: made if it does not exist.
        command: the command line, for the label.
    """
    directory.mkdir(parents=True, exist_ok=True)
    texts = {
        "scenario.toml": scenario_text(scenario),
        TOUR: _json(plan_data(plan, scenario) | {"command": command, **host.describe()}),
    }
    if scenario.origin is not None:
        texts["tour.geojson"] = _json(tour_geojson(scenario, plan))
    canvas.save(tour_figure(plan, scenario), directory / "tour.png")
    for name, text in texts.items():
        write_text(directory / name, text)


def _json(data: dict[str, Any]) -> str:
    return json.dumps(data, indent=1, allow_nan=False) + "\n"

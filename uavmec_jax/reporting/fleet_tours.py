"""The tours of a fleet slot by slot: a column for each UAV, and devices that fail on the way."""

from collections.abc import Sequence
from itertools import groupby
from typing import Any

import jax
import numpy as np
from rich.table import Table

from uavmec_jax.env.dynamics import in_service
from uavmec_jax.env.fleet import DepotKind
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.measures import UavSlots, seconds_until_horizon, uav_slots
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Trace
from uavmec_jax.reporting.labels import device_label, hours
from uavmec_jax.reporting.tours import targets
from uavmec_jax.scenarios.named_scenario import NamedScenario

_MAX_COLUMNS = 4
"""UAVs that a table has columns for; ``--json`` has all."""


def fleet_rows(params: Params, layout: Layout, scenario: NamedScenario, tour: Trace) -> list[dict[str, Any]]:
    """Return one plain dictionary per slot of a tour; devices are numbered from 1.

    Args:
        params: scenario parameters.
        layout: the devices, the UAVs and the depots.
        scenario: it has the names.
        tour: its slots, leaves ``[H, ...]``.
    """
    did = jax.tree.map(np.asarray, uav_slots(params, layout, tour))
    works = tour.state.failed_at < 0
    fraction = np.where(works, tour.state.battery / layout.capacity, np.inf)
    age = np.where(works, tour.state.age, -1)
    action, elapsed = targets(tour), np.asarray(tour.state.elapsed)
    return [
        {
            "slot": slot + 1,
            "uavs": [
                _uav_row(layout, scenario, tour, did, slot, v, int(place)) for v, place in enumerate(action[slot])
            ],
            "served": [int(device) + 1 for device in np.flatnonzero(tour.outcome.served[slot])],
            "duration_s": float(tour.outcome.duration[slot]),
            "elapsed_s": float(elapsed[slot]),
            "lowest_battery": {
                "device": int(fraction[slot].argmin()) + 1,
                "fraction": float(fraction[slot].min()) if works[slot].any() else 0.0,
            },
            "oldest_data": {"device": int(age[slot].argmax()) + 1, "slots": max(int(age[slot].max()), 0)},
            "dead": [int(device) + 1 for device in np.flatnonzero(~works[slot])],
        }
        for slot in range(len(action))
    ]


def _uav_row(
    layout: Layout, scenario: NamedScenario, tour: Trace, did: UavSlots, slot: int, v: int, place: int
) -> dict[str, Any]:
    """Return what a UAV does in a slot; its target is ``None`` if it is grounded."""
    depots, depot, service = layout.depots, int(did.depot[slot, v]), None
    if did.swapped[slot, v]:
        service = "swap"
    elif depots is not None and depots.kind[depot] == DepotKind.CHARGE and did.refilled_j[slot, v] > 1.0:
        service = "charge"
    return {
        "name": scenario.uav_names[v],
        "target": scenario.place_names[place] if place >= 0 else None,
        "place": place + 1 if place >= 0 else None,
        "flies": bool(did.flew[slot, v]),
        "energy_j": float(tour.state.uav_energy[slot, v]),
        "at_depot": scenario.depot_names[depot] if depot >= 0 else None,
        "depot_service": service,
        "grounded": bool(tour.state.grounded[slot, v]),
    }


def fleet_table(rows: Sequence[dict[str, Any]], scenario: NamedScenario) -> Table:
    """Return a table of the slots of a tour; slots in which no UAV flies and nothing else changes share a row.

    Places have their numbers: ``#1`` for a device, ``D1`` for a depot. After the place comes the energy left in the UAV, in
    kJ; after a swap the battery is full, and ``+`` says that it is being charged. Devices whose battery is empty are in a
    column of their own, if there are any.

    Args:
        rows: from :func:`fleet_rows`.
        scenario: it has the names.
    """
    uavs = scenario.uav_names[:_MAX_COLUMNS]
    table = Table()
    for column in ("slots", "until\nh:mm"):
        table.add_column(column, justify="right", no_wrap=True)
    for name in uavs:
        table.add_column(f"{name}\nat, kJ", no_wrap=True)
    any_out = any(row["dead"] for row in rows)
    for column in ("served", "lowest\nbattery", "oldest\ndata", *["empty"] * any_out):
        lists = column in ("served", "empty")
        table.add_column(column, justify="left" if lists else "right", no_wrap=not lists)
    for group in _groups(rows):
        first, last = group[0], group[-1]
        slots = f"{first['slot']}" if first is last else f"{first['slot']}-{last['slot']}"
        battery, data = last["lowest_battery"], last["oldest_data"]
        table.add_row(
            slots,
            hours(last["elapsed_s"]),
            *(_uav_cell(scenario, uav) for uav in last["uavs"][: len(uavs)]),
            _numbers(last["served"]),
            f"#{battery['device']} {battery['fraction']:.0%}",
            f"#{data['device']} {data['slots']}" if data["slots"] else "-",
            *[_numbers(last["dead"])] * any_out,
        )
    return table


def _numbers(devices: Sequence[int]) -> str:
    return " ".join(f"#{device}" for device in devices)


def hidden_uavs(scenario: NamedScenario) -> int:
    """Return how many UAVs have no column in :func:`fleet_table`."""
    return max(len(scenario.uav_names) - _MAX_COLUMNS, 0)


def _groups(rows: Sequence[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """Put consecutive slots together in which all UAVs stay where they are and nothing else changes."""
    starts, previous = [], None
    for row in rows:
        same = previous is not None and _what_happens(row) == _what_happens(previous)
        starts.append(not same or any(uav["flies"] or uav["depot_service"] == "swap" for uav in row["uavs"]))
        previous = row
    numbers = np.cumsum(starts).tolist()
    return [
        [row for _, row in group] for _, group in groupby(zip(numbers, rows, strict=True), key=lambda pair: pair[0])
    ]


def _what_happens(row: dict[str, Any]) -> tuple:
    uavs = tuple((uav["place"], uav["at_depot"], uav["depot_service"], uav["grounded"]) for uav in row["uavs"])
    return uavs, tuple(row["served"]), tuple(row["dead"])


def _uav_cell(scenario: NamedScenario, uav: dict[str, Any]) -> str:
    """Say where a UAV is, what the depot did for it, and its energy after the slot."""
    energy = f"{uav['energy_j'] / 1e3:.0f}"
    if uav["grounded"]:
        return "grounded"
    if uav["at_depot"] is None:
        return f"#{uav['place']} {energy}"
    depot = f"D{scenario.depot_names.index(uav['at_depot']) + 1}"
    if uav["depot_service"] == "swap":
        return f"{depot} swap"
    return f"{depot} {energy}+" if uav["depot_service"] else f"{depot} {energy}"


def device_rows(params: Params, layout: Layout, tour: Trace) -> list[dict[str, Any]]:
    """Return how each device fares until the horizon: when its battery is empty, and its share of the time in service."""
    seconds = np.asarray(seconds_until_horizon(params, tour))
    serves = np.asarray(jax.vmap(lambda state: in_service(params, layout, state))(tour.state))
    share = (serves * seconds[:, None]).sum(axis=0) / float(params.horizon_s)
    failed_at, elapsed = tour.state.failed_at[-1], np.asarray(tour.state.elapsed)
    out = failed_at >= 0
    first = np.argmax(tour.state.failed_at >= 0, axis=0)
    return [
        {
            "device": device + 1,
            "in_service": float(share[device]),
            "battery_empty_slot": int(failed_at[device]) if out[device] else None,
            "battery_empty_s": float(elapsed[first[device]]) if out[device] else None,
        }
        for device in range(layout.n_devices)
    ]


def device_table(rows: Sequence[dict[str, Any]], names: Sequence[str], first_failure: Sequence[float]) -> Table:
    """Return a table of :func:`device_rows`, the least time in service first.

    Args:
        rows: one per device.
        names: of the devices.
        first_failure: share of the draws in which each device is the first to fail.
    """
    table = Table()
    for column in ("device", "in service", "battery\nempty, h:mm", "fails\nfirst"):
        table.add_column(column, justify="left" if column == "device" else "right")
    for row in sorted(rows, key=lambda row: row["in_service"]):
        empty, share = row["battery_empty_s"], first_failure[row["device"] - 1]
        table.add_row(
            device_label(row["device"], names[row["device"] - 1]),
            f"{row['in_service']:.1%}",
            "-" if empty is None else hours(empty),
            f"{share:.0%}" if share > 0 else "-",
        )
    return table

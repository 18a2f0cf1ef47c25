"""The tour of the only UAV slot by slot, as a table and as plain data."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from rich.table import Table

from uavmec_jax.env.layout import fleet_of
from uavmec_jax.env.rollout import Trace
from uavmec_jax.planning.plan import Plan
from uavmec_jax.reporting.labels import device_label


def tour_table(plan: Plan, names: Sequence[str], tour: Trace) -> Table:
    """Return a table with one row per slot of a tour; see :func:`slot_rows`."""
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
    flights = np.linalg.norm(np.diff(uav_stops(plan, tour, 0), axis=0), axis=1)
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


def targets(tour: Trace) -> Int[np.ndarray, "slots K"]:
    """Return the place that each UAV flies to or stays at in each slot; -1 where it is grounded, whose action is ignored."""
    action = np.asarray(tour.action).reshape(len(tour.action), -1)
    return np.where(np.asarray(tour.state.grounded), -1, action)


def uav_stops(plan: Plan, tour: Trace, uav: int) -> Float[np.ndarray, "stops 2"]:
    """Return where a UAV is before the first slot of a tour and after each, m."""
    start = np.asarray(fleet_of(plan.params, plan.layout).start_m, float)[uav]
    return np.concatenate([start[None], tour.state.uav_position[:, uav]])

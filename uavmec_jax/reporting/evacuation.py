"""A simulated evacuation as a table, as lines of text and as plain data."""

from typing import Any

from rich.table import Table
from rich.text import Text

from uavmec_jax.traffic.evacuation import HIGH_TRAFFIC, Evacuation


def evacuation_table(evacuation: Evacuation) -> Table:
    """Return a table with one row per device; devices in high traffic are bold."""
    table = Table()
    for column in ("#", "device", "m east", "m north", "vehicles/km/lane", "± seeds", "weight"):
        table.add_column(column, justify="left" if column == "device" else "right")
    position = evacuation.local_position()
    for k, name in enumerate(evacuation.meta["names"]):
        table.add_row(
            str(k + 1),
            Text(name),  # no markup
            f"{position[k, 0]:.0f}",
            f"{position[k, 1]:.0f}",
            f"{evacuation.density[k]:.1f}",
            f"{evacuation.density_spread[k]:.1f}",
            f"{evacuation.weight[k]:.2f}",
            style="bold" if evacuation.busy[k] else None,
        )
    return table


def evacuation_lines(evacuation: Evacuation) -> list[str]:
    """Return the lines below the table: how the evacuation was simulated, and warnings."""
    meta = evacuation.meta
    first, last = (seconds / 60 for seconds in meta["mean_s"])
    loaded, unfinished, teleports = (sum(meta[name]) for name in ("loaded", "unfinished", "teleports"))
    width, height = evacuation.region_m()
    lines = [
        f"Means over {first:.0f} to {last:.0f} min after the order to leave and over {meta['seeds']} simulations; roads "
        f"within {meta['radius_m']:g} m. Bold: high traffic, a weight of {HIGH_TRAFFIC:g} or more.",
        f"{loaded:,} vehicles in all ({meta['vehicles']:,} evacuated in each), {unfinished:,} had not left at the end, "
        f"{teleports:,} were stuck and moved on. The devices span {width:,.0f} x {height:,.0f} m. SUMO {meta['sumo']}.",
    ]
    if meta["cut_off"]:
        lines.append(f"{meta['cut_off']} residential roads have no way to any exit; no vehicle leaves from there.")
    return lines + [f"Warning: {line}." for line in meta["warnings"]]


def evacuation_data(evacuation: Evacuation) -> dict[str, Any]:
    """Return the evacuation as plain data, without the roads; ``uavmec traffic show --json`` prints it."""
    position = evacuation.local_position()
    meta = {name: value for name, value in evacuation.meta.items() if name not in ("roads", "names")}
    devices = [
        {
            "number": k + 1,
            "name": name,
            "x_m": round(float(position[k, 0]), 1),
            "y_m": round(float(position[k, 1]), 1),
            "density": round(float(evacuation.density[k]), 3),
            "density_spread": round(float(evacuation.density_spread[k]), 3),
            "weight": round(float(evacuation.weight[k]), 4),
            "window_weight": [round(float(weight), 4) for weight in evacuation.window_weight[:, k]],
            "high_traffic": bool(evacuation.busy[k]),
        }
        for k, name in enumerate(evacuation.meta["names"])
    ]
    return {"meta": meta, "devices": devices}

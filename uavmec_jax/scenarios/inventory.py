"""Turn the tables of a scenario file into arrays: devices, depots and UAVs."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from uavmec_jax.env import hardware
from uavmec_jax.env.fleet import (
    DEPOT_POWER_W,
    MAX_UAVS,
    UAV_FIELDS,
    DepotKind,
    Depots,
    Fleet,
    make_depots,
    make_fleet,
)
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import MAX_DEVICES, Params
from uavmec_jax.files.validation import suggest
from uavmec_jax.scenarios.region import Positions
from uavmec_jax.scenarios.schema import DepotSettings, Device, ScenarioFile, label

_HARDWARE_FIELDS = ("standby_power_w", "active_power_w", "processing_rate_bytes_s")


def check_inventory(file: ScenarioFile) -> None:
    """Check the numbers of tables and their names, and the settings that only some kinds of depots have.

    Raises:
        ValueError: one line that names the table.
    """
    if not 1 <= len(file.device) <= MAX_DEVICES:
        raise ValueError(f"holds {len(file.device)} devices; give 1 to {MAX_DEVICES} [[device]] tables or lines")
    for table, most in (("depot", MAX_DEVICES), ("uav", MAX_UAVS)):
        if (count := len(getattr(file, table))) > most:
            raise ValueError(f"holds {count} [[{table}]] tables; give at most {most}")
    places = [("device", number, name) for number, name in enumerate(file.device_names, 1)]
    _check_names(places + [("depot", number, name) for number, name in enumerate(file.depot_names, 1)])
    _check_names([("uav", number, name) for number, name in enumerate(file.uav_names, 1)])
    if all(device.priority == 0 for device in file.device):
        raise ValueError("priority is 0 for all devices; give at least one of them more")
    check_depots(file.depot)


def check_depots(tables: Sequence[DepotSettings]) -> None:
    """Check that depots have only the settings of their kind.

    Raises:
        ValueError: one line that names the depot.
    """
    for number, depot in enumerate(tables, 1):
        field, does, other = ("power_w", "swaps", "charge") if depot.kind == "swap" else ("packs", "charges", "swap")
        if (value := getattr(depot, field)) is not None:
            raise ValueError(
                f"{label('depot', number, depot.name)}: {field} is {value:g}, but it {does} batteries; leave {field} out, "
                f'or give kind = "{other}"'
            )


def _check_names(named: Sequence[tuple[str, int, str]]) -> None:
    """Check that no two of the tables have the same name."""
    seen: dict[str, str] = {}
    for table, number, name in named:
        if name in seen:
            which = "another" if seen[name] == table else "a"
            raise ValueError(f"{table} {number}: name is {name!r}, which {which} {seen[name]} has; names must differ")
        seen[name] = table


def build_layout(file: ScenarioFile, params: Params, positions: Positions) -> Layout:
    """Return the devices, the depots and the UAVs as arrays; ``None`` for what the file leaves out.

    Raises:
        ValueError: the hardware of a device is unknown; one line.
    """
    devices = file.device
    powers = np.array([_hardware(number, device) for number, device in enumerate(devices, 1)])
    priority = None
    if any(device.priority is not None for device in devices):
        priority = jnp.asarray(_column(devices, "priority", 1.0))
    return Layout(
        position=jnp.asarray(positions.devices, jnp.float32),
        device_type=jnp.asarray([_index(device.type, hardware.DEVICE_TYPES) for device in devices], jnp.int32),
        task=jnp.asarray([_index(device.task, hardware.TASKS) for device in devices], jnp.int32),
        capacity=jnp.asarray([device.capacity_j for device in devices], jnp.float32),
        has_power=jnp.asarray([device.power for device in devices]),
        has_comms=jnp.asarray([device.comms for device in devices]),
        standby_power=jnp.asarray(powers[:, 0], jnp.float32),
        active_power=jnp.asarray(powers[:, 1], jnp.float32),
        processing_rate=jnp.asarray(powers[:, 2], jnp.float32),
        priority=priority,
        fleet=_fleet(file, params, positions),
        depots=depots_of(file.depot, positions.depots),
    )


def depots_of(tables: Sequence[DepotSettings], position: Float[np.ndarray, "D 2"]) -> Depots | None:
    """Return the depots of the tables at the given positions, m; ``None`` without tables."""
    if not tables:
        return None
    numbers = {
        field: _column(tables, field, default)
        for field, default in (("pads", np.inf), ("packs", np.inf), ("power_w", DEPOT_POWER_W))
    }
    return make_depots(position, [depot.kind for depot in tables], **numbers)


def _fleet(file: ScenarioFile, params: Params, positions: Positions) -> Fleet | None:
    """Return the UAVs, ``None`` without tables."""
    if not file.uav:
        return None
    numbers: dict[str, Any] = {field: _column(file.uav, field, getattr(params, f"uav_{field}")) for field in UAV_FIELDS}
    return make_fleet(params, len(file.uav), start_m=positions.starts, **numbers)


def _column(tables: Sequence[Any], field: str, default: Any) -> Float[np.ndarray, " m"]:
    """Return one setting of all tables, with the default where it is missing."""
    return np.array([default if (value := getattr(table, field)) is None else value for table in tables], np.float32)


def device_tables(layout: Layout, names: Sequence[str]) -> list[dict[str, Any]]:
    """Return devices, leaves ``[n]`` as NumPy arrays, as the tables of a scenario file; padding is left out.

    Powers and rates are given where they are not those of the paper's tables.
    """
    present = np.ones(len(names), bool) if layout.present is None else layout.present
    tables = []
    for i in np.flatnonzero(present).tolist():
        kind, task = int(layout.device_type[i]), int(layout.task[i])
        table = _named(names[i], np.asarray(layout.position)[i]) | {
            "type": None if kind == hardware.UNLISTED else hardware.DEVICE_TYPES[kind],
            "task": None if task == hardware.UNLISTED else hardware.TASKS[task],
            "capacity_j": float(layout.capacity[i]),
            "power": bool(layout.has_power[i]),
            "comms": bool(layout.has_comms[i]),
        }
        given = layout.standby_power[i], layout.active_power[i], layout.processing_rate[i]
        unlisted = hardware.UNLISTED in (kind, task)
        for field, value, listed in zip(_HARDWARE_FIELDS, given, _listed(kind, task), strict=True):
            if unlisted or value != listed:
                table[field] = float(value)
        if layout.priority is not None:
            table["priority"] = float(layout.priority[i])
        tables.append(table)
    return tables


def _listed(kind: int, task: int) -> tuple[np.float32, np.float32, np.float32]:
    """Return standby power, active power and processing rate of the paper's tables."""
    return (
        hardware.STANDBY_POWER_W[kind],
        hardware.ACTIVE_POWER_W[task, kind],
        hardware.PROCESSING_RATE_BYTES_S[task, kind],
    )


def depot_tables(depots: Depots | None) -> list[dict[str, Any]]:
    """Return depots, leaves ``[D]`` as NumPy arrays, as the tables of a scenario file; padding is left out."""
    if depots is None:
        return []
    tables, positions = [], np.asarray(depots.position)
    for number, d in enumerate(np.flatnonzero(depots.pads >= 1), 1):
        swaps = bool(depots.kind[d] == DepotKind.SWAP)
        table = _named(f"depot {number}", positions[d]) | {"kind": "swap" if swaps else "charge"}
        for field, default in (("pads", np.inf), ("packs", np.inf) if swaps else ("power_w", DEPOT_POWER_W)):
            if (value := float(getattr(depots, field)[d])) != default:
                table[field] = value
        tables.append(table)
    return tables


def uav_tables(fleet: Fleet | None, params: Params, depots: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return UAVs, leaves ``[K]`` as NumPy arrays, as the tables of a scenario file that has these depots.

    Padding is left out.
    """
    if fleet is None:
        return []
    positions = np.array([[depot["x_m"], depot["y_m"]] for depot in depots]).reshape(-1, 2)
    tables, starts = [], np.asarray(fleet.start_m)
    for number, v in enumerate(_present(fleet), 1):
        table = _named(f"uav {number}", starts[v])
        if (depot := place_at(starts[v], positions, [it["name"] for it in depots])) is not None:
            table = {"name": table["name"], "at": depot}
        for field in UAV_FIELDS:
            if (value := getattr(fleet, field)[v]) != np.float32(getattr(params, f"uav_{field}")):
                table[field] = float(value)
        tables.append(table)
    return tables


def _present(fleet: Fleet) -> Int[np.ndarray, " m"]:
    """Return the numbers of the UAVs that are not padding."""
    return np.arange(len(fleet.speed_m_s)) if fleet.present is None else np.flatnonzero(fleet.present)


def _named(name: str, position: Float[np.ndarray, "2"]) -> dict[str, Any]:
    return {"name": name, "x_m": float(position[0]), "y_m": float(position[1])}


def place_at(position: Float[np.ndarray, "2"], places: Float[np.ndarray, "m 2"], names: Sequence[str]) -> str | None:
    """Return the name of the last of the places that are exactly at a position; ``None`` if none is."""
    at = np.flatnonzero(np.all(places == position, axis=1))
    return names[at[-1]] if at.size else None


def _index(name: str | None, names: tuple[str, ...]) -> int:
    """Return the index of a name in the paper's tables."""
    return names.index(name) if name in names else hardware.UNLISTED


def _hardware(number: int, device: Device) -> tuple[float, float, float]:
    """Return standby power, active power and processing rate: the given ones, else those of the paper's tables."""
    given = [getattr(device, field) for field in _HARDWARE_FIELDS]
    for field, names in (("type", hardware.DEVICE_TYPES), ("task", hardware.TASKS)):
        name = getattr(device, field)
        needed = given if field == "type" else given[1:]  # the standby power depends on the type alone
        if name not in names and None in needed:
            problem = f"is {name!r}, which the tables do not list; {suggest(name, names)}" if name else "is missing"
            raise ValueError(
                f"{label('device', number, device.name)}: {field} {problem}; or give {', '.join(_HARDWARE_FIELDS)}"
            )
    kind, task = _index(device.type, hardware.DEVICE_TYPES), _index(device.task, hardware.TASKS)
    standby, active, rate = (
        float(table if value is None else value) for value, table in zip(given, _listed(kind, task), strict=True)
    )
    return standby, active, rate

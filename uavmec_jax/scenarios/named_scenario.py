"""Inventories: one's own devices, with names, checked, as a :class:`Layout`; and a random layout as an inventory."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pydantic

from uavmec_jax.env import hardware as tables
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import MAX_DEVICES, Params
from uavmec_jax.errors import LayoutError
from uavmec_jax.files.validation import nearest, tuples, wanted
from uavmec_jax.scenarios.schema import Device, InventoryFile
from uavmec_jax.scenarios.settings import ParamsSettings, check_ranges

OWN = -1
"""``device_type`` and ``task`` of a device that the tables do not know."""

_EARTH_RADIUS_M = 6_371_008.8
_OWN_FIELDS = ("standby_power_w", "active_power_w", "processing_rate_bytes_s")


@dataclass(frozen=True)
class Inventory:
    """Devices with names, ready to be planned for.

    Attributes:
        file: what the file says.
        params: Table 1 with the file's changes; the region is what the devices span if they are geographic.
        layout: the devices, in the order of the file.
        origin: longitude and latitude of the corner where the UAV starts, if known.
    """

    file: InventoryFile
    params: Params
    layout: Layout
    origin: tuple[float, float] | None

    @property
    def names(self) -> list[str]:
        """Names of the devices."""
        return [device.name for device in self.file.device]

    def geographic(self, position: np.ndarray) -> np.ndarray:
        """Longitude and latitude ``[..., 2]`` of positions in metres.

        Raises:
            LayoutError: the inventory has no origin.
        """
        if self.origin is None:
            raise LayoutError(f"{self.file.name}: has no place on the map; give origin = [longitude, latitude]")
        return np.asarray(position, float) / _metres_per_degree(self.origin[1]) + np.array(self.origin)


def _metres_per_degree(latitude: float) -> np.ndarray:
    """``[2]`` metres per degree of longitude and of latitude (equirectangular, exact enough over a town)."""
    per_degree = math.radians(1.0) * _EARTH_RADIUS_M
    return np.array([per_degree * math.cos(math.radians(latitude)), per_degree])


def make_inventory(data: dict[str, Any], source: str, overrides: dict[str, Any] | None = None) -> Inventory:
    """An inventory from plain data as a layout file holds it; ``source`` names it in messages.

    Raises:
        LayoutError: something does not fit; one line.
    """
    if isinstance(data.get("params", {}), dict):
        given = data.get("params", {}) | (overrides or {})
        data = data | {"params": tuples(given)}
    try:
        file = InventoryFile.model_validate(data)
    except pydantic.ValidationError as error:
        raise LayoutError(f"{source}: {_first_problem(data, error)}") from None
    try:
        return _build(file)
    except ValueError as error:
        raise LayoutError(f"{source}: {error}") from None


def _first_problem(data: dict[str, Any], error: pydantic.ValidationError) -> str:
    """The first problem in words: which device, which field, what is there, what would be right."""
    first = error.errors()[0]
    place = [part for part in first["loc"] if part not in ("int", "str", "float", "bool")]
    known: Any = InventoryFile
    where = ""
    if place[0] == "device" and len(place) > 1 and isinstance(place[1], int):
        entry = data["device"][place[1]]
        name = entry.get("name", "no name") if isinstance(entry, dict) else entry
        where, known, place = f"device {place[1] + 1} ({name}): ", Device, place[2:]
    elif place[0] == "params":
        known = ParamsSettings
    field = ".".join(str(part) for part in place)
    if first["type"] == "extra_forbidden":
        return f"{where}{field} is not a field; {nearest(str(place[-1]), known.model_fields)}"
    if first["type"] == "missing":
        return f"{where}{field} is missing"
    return f"{where}{field} is {first['input']!r}; {wanted(first)}"


def _build(file: InventoryFile) -> Inventory:
    check_ranges(file.params, "params.")
    if not 1 <= len(file.device) <= MAX_DEVICES:
        raise ValueError(f"holds {len(file.device)} devices; give 1 to {MAX_DEVICES} [[device]] tables or lines")
    seen: set[str] = set()
    for number, device in enumerate(file.device, 1):
        if device.name in seen:
            raise ValueError(f"device {number}: name is {device.name!r}, which another device has; names must differ")
        seen.add(device.name)
    position, origin = _positions(file)
    settings = {name: value for name, value in file.params.model_dump().items() if name != "n_devices"}
    if "n_devices" in file.params.model_fields_set and file.params.n_devices != len(file.device):
        raise ValueError(
            f"params.n_devices is {file.params.n_devices}, but there are {len(file.device)} devices; leave it out"
        )
    if origin is not None and "region_m" not in file.params.model_fields_set and file.device[0].lon is not None:
        settings["region_m"] = tuple(float(side) for side in np.maximum(position.max(axis=0), 1.0))
    params = Params(n_devices=len(file.device), **settings)
    _check_places(file, params, position)
    hardware = np.array([_hardware(number, device) for number, device in enumerate(file.device, 1)])
    layout = Layout(
        position=jnp.asarray(position, jnp.float32),
        device_type=jnp.asarray([_index(device.type, tables.DEVICE_TYPES) for device in file.device], jnp.int32),
        task=jnp.asarray([_index(device.task, tables.TASKS) for device in file.device], jnp.int32),
        capacity=jnp.asarray([device.capacity_j for device in file.device], jnp.float32),
        has_power=jnp.asarray([device.power for device in file.device]),
        has_comms=jnp.asarray([device.comms for device in file.device]),
        standby_power=jnp.asarray(hardware[:, 0], jnp.float32),
        active_power=jnp.asarray(hardware[:, 1], jnp.float32),
        processing_rate=jnp.asarray(hardware[:, 2], jnp.float32),
    )
    return Inventory(file=file, params=params, layout=layout, origin=origin)


def _positions(file: InventoryFile) -> tuple[np.ndarray, tuple[float, float] | None]:
    """``[n, 2]`` metres from the corner where the UAV starts, and that corner's longitude and latitude if known."""
    metres = [device.x_m is not None and device.y_m is not None for device in file.device]
    degrees = [device.lon is not None and device.lat is not None for device in file.device]
    for number, (device, in_metres, in_degrees) in enumerate(zip(file.device, metres, degrees, strict=True), 1):
        if in_metres == in_degrees or in_degrees != degrees[0]:
            raise ValueError(
                f"device {number} ({device.name}): position is unclear; give x_m and y_m, or lon and lat, the same for all"
            )
    if not degrees[0]:
        return np.array([[device.x_m, device.y_m] for device in file.device], float), file.origin
    places = np.array([[device.lon, device.lat] for device in file.device], float)
    west, south = file.origin or (float(places[:, 0].min()), float(places[:, 1].min()))
    return (places - [west, south]) * _metres_per_degree(south), (west, south)


def _check_places(file: InventoryFile, params: Params, position: np.ndarray) -> None:
    """Everyone is inside the region, and one charge of the UAV is enough for any hop."""
    for number, (device, place) in enumerate(zip(file.device, position, strict=True), 1):
        if np.any(place < 0) or np.any(place > np.array(params.region_m) * (1 + 1e-6)):
            raise ValueError(
                f"device {number} ({device.name}): lies at {place[0]:.0f}, {place[1]:.0f} m, outside the region of "
                f"{params.region_m[0]:g} x {params.region_m[1]:g} m; move it or give a larger params.region_m"
            )
    stops = [("the start", np.zeros(2)), *((d.name, p) for d, p in zip(file.device, position, strict=True))]
    for (here, a), (there, b) in itertools.combinations(stops, 2):
        metres = float(np.linalg.norm(a - b))
        energy = params.uav_flying_power_w * metres / params.uav_speed_m_s
        if energy > params.uav_battery_j:
            raise ValueError(
                f"the hop from {here} to {there}, {metres:,.0f} m, takes {energy / 1e3:,.0f} kJ; the UAV's battery "
                f"holds {params.uav_battery_j / 1e3:,.0f} kJ (params.uav_battery_j)"
            )


def _index(name: str | None, names: tuple[str, ...]) -> int:
    return names.index(name) if name in names else OWN


def _hardware(number: int, device: Device) -> tuple[float, float, float]:
    """Standby power, active power and processing rate: the device's own, else the tables'."""
    own = [getattr(device, field) for field in _OWN_FIELDS]
    where = f"device {number} ({device.name})"
    for field, names in (("type", tables.DEVICE_TYPES), ("task", tables.TASKS)):
        given = getattr(device, field)
        known_from = own[:1] if field == "type" else own[1:]
        if given not in names and (None in own[1:] or None in known_from):
            hint = f"is {given!r}, which the tables do not know; {nearest(given, names)}" if given else "is missing"
            raise ValueError(f"{where}: {field} {hint}; or give {', '.join(_OWN_FIELDS)}")
    kind, task = _index(device.type, tables.DEVICE_TYPES), _index(device.task, tables.TASKS)
    known = (
        tables.STANDBY_POWER_W[kind],
        tables.ACTIVE_POWER_W[task, kind],
        tables.PROCESSING_RATE_BYTES_S[task, kind],
    )
    standby, active, rate = (float(mine if mine is not None else table) for mine, table in zip(own, known, strict=True))
    return standby, active, rate


def inventory_of(layout: Layout, params: Params, name: str, names: Sequence[str] | None = None) -> Inventory:
    """An inventory of a layout that was drawn at random; unless named, devices are ``device 1``, ``device 2``, ..."""
    own = jax.tree.map(np.asarray, layout)
    settings = {field: getattr(params, field) for field in ParamsSettings.model_fields if field != "n_devices"}
    changed = {field: value for field, value in settings.items() if value != getattr(Params(), field)}
    devices = tuple(
        {
            "name": names[i] if names else f"device {i + 1}",
            "x_m": float(own.position[i, 0]),
            "y_m": float(own.position[i, 1]),
            "type": tables.DEVICE_TYPES[own.device_type[i]],
            "task": tables.TASKS[own.task[i]],
            "capacity_j": float(own.capacity[i]),
            "power": bool(own.has_power[i]),
            "comms": bool(own.has_comms[i]),
        }
        for i in range(len(own.capacity))
    )
    return make_inventory({"name": name, "params": changed, "device": devices}, name)

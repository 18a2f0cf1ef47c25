"""Named scenarios: a user's devices with their names, their origin on the map and their present state."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Float, Key

from uavmec_jax.env import hardware
from uavmec_jax.env.dynamics import State, initial_state
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import MAX_DEVICES, Params
from uavmec_jax.errors import ScenarioError, StateError
from uavmec_jax.files.validation import describe_error, suggest
from uavmec_jax.scenarios.schema import Device, ScenarioFile
from uavmec_jax.scenarios.seeds import held_out_draws
from uavmec_jax.scenarios.settings import ParamsSettings, check_ranges

UNLISTED = -1
"""``device_type`` and ``task`` of hardware that the paper's tables do not list."""

_EARTH_RADIUS_M = 6_371_008.8
_HARDWARE_FIELDS = ("standby_power_w", "active_power_w", "processing_rate_bytes_s")


@dataclass(frozen=True)
class NamedScenario:
    """A scenario as its user knows it.

    Attributes:
        file: contents of the scenario file.
        params: Table 1 with the file's changes; the region is the devices' extent where they have geographic coordinates
            and the file gives no region.
        layout: the devices, in the order of the file.
        state: present state, by default the initial one.
        origin: longitude and latitude of the corner where the UAV starts; ``None`` if unknown.
        draw_id: seed and numbers of powered and connected devices, which the volume draws depend on.
    """

    file: ScenarioFile
    params: Params
    layout: Layout
    state: State
    origin: tuple[float, float] | None
    draw_id: tuple[int, int, int] = (0, 0, 0)

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return self.file.name

    @property
    def device_names(self) -> list[str]:
        """Names of the devices."""
        return [device.name for device in self.file.device]

    def geographic(self, position: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Convert positions ``[..., 2]`` in metres to longitudes and latitudes.

        Raises:
            ScenarioError: the scenario has no origin.
        """
        if self.origin is None:
            raise ScenarioError(f"{self.name}: has no place on the map; give origin = [longitude, latitude]")
        return np.asarray(position, float) / _metres_per_degree(self.origin[1]) + np.array(self.origin)

    def draws(self, count: int) -> Key[Array, " D"]:
        """Return ``count`` volume draws; for a random scenario they are those on which studies evaluate policies."""
        return held_out_draws(*self.draw_id, count)

    def with_failure_price(self, price: float) -> "NamedScenario":
        """Return the scenario with a price on the first failure, in slots of lifetime; see :class:`um.Traffic`.

        Raises:
            StateError: the price is negative or not finite, or the traffic of the devices is unknown.
        """
        if not 0 <= price < np.inf:
            raise StateError(f"price is {price}; give slots, a finite number from 0")
        if self.layout.traffic is None:
            raise StateError("price is given, but the traffic of these devices is unknown; give a place, e.g. albany")
        traffic = replace(self.layout.traffic, price=jnp.float32(price))
        return replace(self, layout=replace(self.layout, traffic=traffic))


def _metres_per_degree(latitude: float) -> Float[np.ndarray, "2"]:
    """Return metres per degree of longitude and of latitude (equirectangular: exact enough within a city)."""
    per_degree = math.radians(1.0) * _EARTH_RADIUS_M
    return np.array([per_degree * math.cos(math.radians(latitude)), per_degree])


def make_named_scenario(data: dict[str, Any], source: str, overrides: dict[str, Any] | None = None) -> NamedScenario:
    """Make a scenario from the data of a scenario file.

    Args:
        data: contents of the file, as parsed from TOML.
        source: name of the file, for messages.
        overrides: scenario parameters to change, by name.

    Raises:
        ScenarioError: a value is wrong; one line that names it.
    """
    if isinstance(data.get("params", {}), dict):
        data = data | {"params": data.get("params", {}) | (overrides or {})}
    try:
        file = ScenarioFile.model_validate(data)
    except pydantic.ValidationError as error:
        raise ScenarioError(describe_error(source, error, ScenarioFile, data)) from None
    try:
        return _build(file)
    except ValueError as error:
        raise ScenarioError(f"{source}: {error}") from None


def _build(file: ScenarioFile) -> NamedScenario:
    check_ranges(file.params, "params.")
    if not 1 <= len(file.device) <= MAX_DEVICES:
        raise ValueError(f"holds {len(file.device)} devices; give 1 to {MAX_DEVICES} [[device]] tables or lines")
    _check_names(file)
    position, origin = _positions(file)
    params = _params(file, position)
    _check_positions(file, params, position)
    layout = _layout(file, position)
    return NamedScenario(file, params, layout, initial_state(params, layout), origin)


def _check_names(file: ScenarioFile) -> None:
    """Check that no two devices have the same name."""
    seen: set[str] = set()
    for number, device in enumerate(file.device, 1):
        if device.name in seen:
            raise ValueError(f"device {number}: name is {device.name!r}, which another device has; names must differ")
        seen.add(device.name)


def _params(file: ScenarioFile, position: Float[np.ndarray, "n 2"]) -> Params:
    """Return Table 1 with the file's changes."""
    count, changed = len(file.device), file.params.model_fields_set
    if "n_devices" in changed and file.params.n_devices != count:
        raise ValueError(f"params.n_devices is {file.params.n_devices}, but there are {count} devices; leave it out")
    settings = file.params.model_dump(exclude={"n_devices"})
    if "region_m" not in changed and file.device[0].lon is not None:
        settings["region_m"] = tuple(float(side) for side in np.maximum(position.max(axis=0), 1.0))
    return Params(n_devices=count, **settings)


def _layout(file: ScenarioFile, position: Float[np.ndarray, "n 2"]) -> Layout:
    """Return the devices as arrays."""
    powers = np.array([_hardware(number, device) for number, device in enumerate(file.device, 1)])
    return Layout(
        position=jnp.asarray(position, jnp.float32),
        device_type=jnp.asarray([_index(device.type, hardware.DEVICE_TYPES) for device in file.device], jnp.int32),
        task=jnp.asarray([_index(device.task, hardware.TASKS) for device in file.device], jnp.int32),
        capacity=jnp.asarray([device.capacity_j for device in file.device], jnp.float32),
        has_power=jnp.asarray([device.power for device in file.device]),
        has_comms=jnp.asarray([device.comms for device in file.device]),
        standby_power=jnp.asarray(powers[:, 0], jnp.float32),
        active_power=jnp.asarray(powers[:, 1], jnp.float32),
        processing_rate=jnp.asarray(powers[:, 2], jnp.float32),
    )


def _positions(file: ScenarioFile) -> tuple[Float[np.ndarray, "n 2"], tuple[float, float] | None]:
    """Return positions in metres from the corner where the UAV starts, and that corner's longitude and latitude if known."""
    metres = [device.x_m is not None and device.y_m is not None for device in file.device]
    degrees = [device.lon is not None and device.lat is not None for device in file.device]
    for number, (device, in_metres, in_degrees) in enumerate(zip(file.device, metres, degrees, strict=True), 1):
        if in_metres == in_degrees or in_degrees != degrees[0]:
            raise ValueError(
                f"device {number} ({device.name}): position is unclear; give x_m and y_m, or lon and lat, the same for all"
            )
    if not degrees[0]:
        return np.array([[device.x_m, device.y_m] for device in file.device], float), file.origin
    coordinates = np.array([[device.lon, device.lat] for device in file.device], float)
    west, south = file.origin or (float(coordinates[:, 0].min()), float(coordinates[:, 1].min()))
    return (coordinates - [west, south]) * _metres_per_degree(south), (west, south)


def _check_positions(file: ScenarioFile, params: Params, position: Float[np.ndarray, "n 2"]) -> None:
    """Check that all devices are inside the region, and that the UAV's battery is large enough for any hop."""
    for number, (device, (x, y)) in enumerate(zip(file.device, position, strict=True), 1):
        if min(x, y) < 0 or np.any(np.array([x, y]) > np.array(params.region_m) * (1 + 1e-6)):
            raise ValueError(
                f"device {number} ({device.name}): lies at {x:.0f}, {y:.0f} m, outside the region of "
                f"{params.region_m[0]:g} x {params.region_m[1]:g} m; move it or give a larger params.region_m"
            )
    stops = [("the start", np.zeros(2)), *zip([device.name for device in file.device], position, strict=True)]
    for (here, start), (there, end) in itertools.combinations(stops, 2):
        metres = float(np.linalg.norm(start - end))
        energy = params.uav_flying_power_w * metres / params.uav_speed_m_s
        if energy > params.uav_battery_j:
            raise ValueError(
                f"the hop from {here} to {there}, {metres:,.0f} m, takes {energy / 1e3:,.0f} kJ; the UAV's battery "
                f"holds {params.uav_battery_j / 1e3:,.0f} kJ (params.uav_battery_j)"
            )


def _index(name: str | None, names: tuple[str, ...]) -> int:
    """Return the index of a name in the paper's tables."""
    return names.index(name) if name in names else UNLISTED


def _hardware(number: int, device: Device) -> tuple[float, float, float]:
    """Return standby power, active power and processing rate: the given ones, else those of the paper's tables."""
    given = [getattr(device, field) for field in _HARDWARE_FIELDS]
    for field, names in (("type", hardware.DEVICE_TYPES), ("task", hardware.TASKS)):
        name = getattr(device, field)
        needed = given if field == "type" else given[1:]  # the standby power depends on the type alone
        if name not in names and None in needed:
            problem = f"is {name!r}, which the tables do not list; {suggest(name, names)}" if name else "is missing"
            raise ValueError(
                f"device {number} ({device.name}): {field} {problem}; or give {', '.join(_HARDWARE_FIELDS)}"
            )
    kind, task = _index(device.type, hardware.DEVICE_TYPES), _index(device.task, hardware.TASKS)
    listed = (
        hardware.STANDBY_POWER_W[kind],
        hardware.ACTIVE_POWER_W[task, kind],
        hardware.PROCESSING_RATE_BYTES_S[task, kind],
    )
    standby, active, rate = (
        float(table if value is None else value) for value, table in zip(given, listed, strict=True)
    )
    return standby, active, rate


def name_scenario(
    layout: Layout, params: Params, name: str, device_names: Sequence[str] | None = None
) -> NamedScenario:
    """Name a random scenario; its devices are ``device 1``, ``device 2``, ... unless ``device_names`` are given."""
    names = device_names or [f"device {number}" for number in range(1, len(layout.capacity) + 1)]
    settings = {field: getattr(params, field) for field in ParamsSettings.model_fields if field != "n_devices"}
    changed = {field: value for field, value in settings.items() if value != getattr(Params(), field)}
    arrays = jax.tree.map(np.asarray, layout)
    devices = [
        {
            "name": device_name,
            "x_m": float(arrays.position[i, 0]),
            "y_m": float(arrays.position[i, 1]),
            "type": hardware.DEVICE_TYPES[arrays.device_type[i]],
            "task": hardware.TASKS[arrays.task[i]],
            "capacity_j": float(arrays.capacity[i]),
            "power": bool(arrays.has_power[i]),
            "comms": bool(arrays.has_comms[i]),
        }
        for i, device_name in enumerate(names)
    ]
    return make_named_scenario({"name": name, "params": changed, "device": devices}, name)

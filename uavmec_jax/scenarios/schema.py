"""The schema of scenario files."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from uavmec_jax.env.checks import LEAST_CAPACITY_J, MAX_LENGTH_M
from uavmec_jax.env.fleet import DepotKind
from uavmec_jax.files.validation import PrintableName, PrintableText, StrictModel, from_array, usual_size
from uavmec_jax.scenarios.settings import ParamsSettings

_Power = Annotated[float, Field(ge=0), usual_size]
_Positive = Annotated[float, Field(gt=0), usual_size]
Metres = Annotated[float, Field(ge=-MAX_LENGTH_M, le=MAX_LENGTH_M)]
"""A coordinate, m from the origin."""


def _west_of_180(longitude: float) -> float:
    return round(longitude - 360.0, 10) if longitude > 180.0 else longitude


_Longitude = Annotated[float, Field(ge=-180, le=360), AfterValidator(_west_of_180)]
"""Degrees; those of 180 to 360 become those of -180 to 0."""

_Latitude = Annotated[float, Field(ge=-89, le=89)]


def _whole(value: float) -> float:
    if not (value == float("inf") or value.is_integer()):
        raise PydanticCustomError("whole_number", "Input should be a whole number or inf")
    return value


_Count = Annotated[float, Field(ge=0, allow_inf_nan=True), usual_size, AfterValidator(_whole)]
_CountFromOne = Annotated[float, Field(ge=1, allow_inf_nan=True), usual_size, AfterValidator(_whole)]
_Kind: Any = Literal[tuple(kind.name.lower() for kind in DepotKind)]


class Named(StrictModel):
    """Something that may have a name."""

    name: PrintableName | None = None


class Located(Named):
    """Something with a name and a position, which is either ``x_m, y_m`` or ``lon, lat``. Units are in the names."""

    x_m: Metres | None = None
    y_m: Metres | None = None
    lon: _Longitude | None = None
    lat: _Latitude | None = None


class Device(Located):
    """One device."""

    name: PrintableName
    type: PrintableText | None = None
    """A name in :data:`hardware.DEVICE_TYPES`; any other needs the three numbers below ``task``."""
    task: PrintableText | None = None
    """A name in :data:`hardware.TASKS`."""
    standby_power_w: _Power | None = None
    active_power_w: _Power | None = None
    processing_rate_bytes_s: _Positive | None = None
    capacity_j: Annotated[float, Field(ge=LEAST_CAPACITY_J), usual_size]
    power: bool = False
    comms: bool = False
    priority: Annotated[float, Field(ge=0), usual_size] | None = None
    """Weight in measures of service; 1 if it is left out."""


class DepotSettings(Named):
    """What one depot does; what is missing is as in :func:`make_depots`."""

    kind: _Kind = "swap"
    pads: _CountFromOne | None = None
    packs: _Count | None = None
    """Full batteries in stock; only of a depot that swaps."""
    power_w: _Power | None = None
    """Power per UAV; only of a depot that charges."""


class DepotTable(DepotSettings, Located):
    """One depot, by default ``depot 1``, ``depot 2``, ..."""


class Uav(Located):
    """One UAV, by default ``uav 1``, ``uav 2``, ...; missing numbers are those of the parameters.

    The position is its start; without one, UAV ``v`` starts at depot ``v mod D``, or at the origin if there are no depots.
    """

    at: PrintableText | None = None
    """Name of the device or depot where it starts."""
    speed_m_s: _Positive | None = None
    flying_power_w: _Power | None = None
    hovering_power_w: _Positive | None = None
    battery_j: _Positive | None = None
    signal_range_m: Annotated[float, Field(gt=0, le=MAX_LENGTH_M), usual_size] | None = None


class ScenarioFile(StrictModel):
    """Contents of a scenario file."""

    name: PrintableText = ""
    origin: Annotated[tuple[_Longitude, _Latitude] | None, from_array] = None
    """Longitude and latitude of the corner ``x_m = y_m = 0``."""
    region: Annotated[tuple[Annotated[tuple[Metres, Metres], from_array], ...] | None, from_array] = None
    """Corners of a polygon that all positions lie in, in the coordinates of the devices; it replaces ``params.region_m``."""
    params: ParamsSettings = ParamsSettings()
    device: Annotated[tuple[Device, ...], from_array] = ()
    depot: Annotated[tuple[DepotTable, ...], from_array] = ()
    uav: Annotated[tuple[Uav, ...], from_array] = ()
    """Without one, there is the UAV of the parameters."""

    @property
    def device_names(self) -> list[str]:
        """Names of the devices."""
        return [device.name for device in self.device]

    @property
    def depot_names(self) -> list[str]:
        """Names of the depots."""
        return [depot.name or f"depot {number}" for number, depot in enumerate(self.depot, 1)]

    @property
    def place_names(self) -> list[str]:
        """Names of the places that a UAV can fly to: the devices, then the depots."""
        return self.device_names + self.depot_names

    @property
    def uav_names(self) -> list[str]:
        """Names of the UAVs, of which there is at least one."""
        return [uav.name or f"uav {number}" for number, uav in enumerate(self.uav or (Uav(),), 1)]


def label(table: str, number: int, name: str | None) -> str:
    """Return how messages name a table in a list, e.g. ``device 2 (quay)``."""
    return f"{table} {number} ({name or 'no name'})"

"""The schema of scenario files."""

from typing import Annotated

from pydantic import Field

from uavmec_jax.files.validation import StrictModel, from_array
from uavmec_jax.scenarios.settings import ParamsSettings

_Power = Annotated[float, Field(ge=0)]
_Longitude = Annotated[float, Field(ge=-180, le=180)]
_Latitude = Annotated[float, Field(ge=-89, le=89)]


class Device(StrictModel):
    """One device; its position is either ``x_m, y_m`` or ``lon, lat``. Units are in the names."""

    name: Annotated[str, Field(min_length=1, max_length=80)]
    x_m: float | None = None
    y_m: float | None = None
    lon: _Longitude | None = None
    lat: _Latitude | None = None
    type: str | None = None
    """A name in :data:`hardware.DEVICE_TYPES`; any other needs the three numbers below ``task``."""
    task: str | None = None
    """A name in :data:`hardware.TASKS`."""
    standby_power_w: _Power | None = None
    active_power_w: _Power | None = None
    processing_rate_bytes_s: Annotated[float, Field(gt=0)] | None = None
    capacity_j: Annotated[float, Field(gt=0)]
    power: bool = False
    comms: bool = False


class ScenarioFile(StrictModel):
    """Contents of a scenario file."""

    name: str = ""
    origin: Annotated[tuple[_Longitude, _Latitude] | None, from_array] = None
    """Longitude and latitude of the corner ``x_m = y_m = 0``."""
    params: ParamsSettings = ParamsSettings()
    device: Annotated[tuple[Device, ...], from_array] = ()

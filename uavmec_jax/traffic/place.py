"""Places: a road network, its travel demand and its devices, read from TOML; every value is checked."""

from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import pydantic
from pydantic import Field

from uavmec_jax.env.params import MAX_DEVICES
from uavmec_jax.errors import TrafficError
from uavmec_jax.files.parsing import parse_toml
from uavmec_jax.files.reading import read_text
from uavmec_jax.files.validation import StrictModel, describe_error, from_array, suggest

_Positive = Annotated[float, Field(gt=0, le=1e7)]
_NotNegative = Annotated[float, Field(ge=0, le=1e7)]

PLACES = resources.files("uavmec_jax.traffic") / "places"


def shipped_places() -> tuple[str, ...]:
    """Return the names of the places that ship with the package."""
    return tuple(sorted(folder.name for folder in PLACES.iterdir() if folder.is_dir()))


class NetworkSource(StrictModel):
    """The files that the roads come from, of one of three kinds. Paths are relative to the file of the place."""

    nodes: str | None = None
    """SUMO's plain XML, together with ``edges`` and ``types``."""
    edges: str | None = None
    types: str | None = None
    osm: str | None = None
    """An OpenStreetMap extract: .osm, .osm.gz or .osm.bz2."""
    bbox: Annotated[tuple[float, float, float, float] | None, from_array] = None
    """Part of the extract: west, south, east, north, in degrees."""
    net: str | None = None
    """A network built by SUMO's netconvert."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> "NetworkSource":
        plain = [self.nodes, self.edges, self.types]
        if sum([any(plain), self.osm is not None, self.net is not None]) != 1 or (any(plain) and not all(plain)):
            raise ValueError("network is unclear; give osm, or net, or all of nodes, edges and types")
        if self.bbox is not None:
            west, south, east, north = self.bbox
            if self.osm is None:
                raise ValueError("network.bbox is given without network.osm; it cuts an OpenStreetMap extract")
            if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):
                raise ValueError(f"network.bbox is {list(self.bbox)}; give [west, south, east, north] in degrees")
        return self


class Demand(StrictModel):
    """Travel demand: which vehicles drive, and when."""

    vehicles: Annotated[int, Field(ge=1, le=1_000_000)] = 4000
    """Vehicles that are evacuated."""
    loading_sigma_s: _Positive = 1200.0
    """Rayleigh loading: a share ``1 - exp(-t^2 / (2 sigma^2))`` of them has left ``t`` seconds after the order to leave."""
    through_per_hour: _NotNegative = 600.0
    """Vehicles per hour that pass through, from one highway end to another."""
    warm_up_s: _NotNegative = 600.0
    """Seconds of through traffic before the order to leave."""
    origins: Annotated[tuple[str, ...], from_array] = ()
    """Roads where people live, weighted by their lengths; by default the residential roads."""
    exits: dict[str, _Positive] = Field(default_factory=dict)
    """Junctions or roads where vehicles leave -> weight; by default the highway ends, weighted by lanes times speed."""
    rerouting: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Share of the drivers who look for a faster route on the way."""


class Simulation(StrictModel):
    """Settings of the simulations and of the averages over them."""

    seeds: Annotated[int, Field(ge=1, le=1000)] = 5
    duration_s: _Positive = 7200.0
    """Seconds simulated after the order to leave."""
    window_s: _Positive = 600.0
    """Length of the windows over which densities are averaged."""
    mean_s: Annotated[tuple[_NotNegative, _Positive], from_array] = (0.0, 3600.0)
    """Part of the evacuation over which the devices' weights are averaged."""
    time_limit_s: _Positive = 900.0
    """Wall-clock seconds after which one simulation is stopped."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> "Simulation":
        if self.window_s > self.duration_s:
            raise ValueError(
                f"simulation.window_s is {self.window_s:g}; it should be at most duration_s ({self.duration_s:g})"
            )
        if self.duration_s / self.window_s > 1000:
            raise ValueError(
                f"simulation.window_s is {self.window_s:g}; give at most 1000 windows in {self.duration_s:g} s"
            )
        first, last = self.windows
        if not 0 <= first < last:
            raise ValueError(
                f"simulation.mean_s is {list(self.mean_s)}; give [from, to] with whole windows within the evacuation"
            )
        return self

    @property
    def n_windows(self) -> int:
        """Number of windows in the evacuation."""
        return int(self.duration_s // self.window_s)

    @property
    def windows(self) -> tuple[int, int]:
        """First window of the mean, and one past the last."""
        return round(self.mean_s[0] / self.window_s), min(round(self.mean_s[1] / self.window_s), self.n_windows)


class Site(StrictModel):
    """A device of the file: at a junction, or at a point of the network in metres."""

    name: Annotated[str, Field(min_length=1, max_length=80)]
    junction: str | None = None
    x_m: float | None = None
    y_m: float | None = None

    @pydantic.model_validator(mode="after")
    def _check(self) -> "Site":
        if (self.junction is None) != (self.x_m is not None and self.y_m is not None):
            raise ValueError(f"device {self.name!r}: place is unclear; give junction, or x_m and y_m")
        return self


class Placement(StrictModel):
    """How to place devices that the file does not list: at junctions far apart, a share of them on busy corridors."""

    count: Annotated[int, Field(ge=2, le=MAX_DEVICES)] = 12
    corridor_share: Annotated[float, Field(ge=0, le=1)] = 0.5
    """Share of the devices that stand at the fifth of the junctions with the densest traffic."""
    span_m: _Positive = 1500.0
    """Side of the square, around the centre of the origins, in which they are placed."""
    radius_m: _Positive = 100.0
    """Distance from a device within which roads count towards its weight."""


class Place(StrictModel):
    """A place and its evacuation."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=80)]
    description: str = ""
    network: NetworkSource
    demand: Demand = Demand()
    simulation: Simulation = Simulation()
    devices: Placement = Placement()
    device: Annotated[tuple[Site, ...], from_array] = ()

    @pydantic.model_validator(mode="after")
    def _check(self) -> "Place":
        names = [site.name for site in self.device]
        if self.device and not 2 <= len(names) <= MAX_DEVICES:
            raise ValueError(f"holds {len(names)} [[device]] tables; give 2 to {MAX_DEVICES}, or none")
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"device name {name!r} is given twice; names must differ")
        return self


def load_place(source: str | Path, overrides: dict[str, Any] | None = None) -> tuple[Place, Path]:
    """Load a place that ships with the package, or a file.

    Args:
        source: ``"albany"``, or the path of a ``.toml`` file.
        overrides: tables of settings, which take precedence over those of the file, and a list of devices, which replaces
            the file's.

    Returns:
        The place, and the folder that its paths are relative to.

    Raises:
        TrafficError: the file does not exist, is not TOML, or holds an invalid value; one line.
    """
    if str(source) in shipped_places():
        path = Path(str(PLACES / str(source) / "place.toml"))
    else:
        path = Path(source)
        if not path.is_file():
            raise TrafficError(
                f"{source}: neither a file nor a shipped place; {suggest(str(source), shipped_places())}"
            )
    data = parse_toml(read_text(path, TrafficError), path, TrafficError)
    for table, settings in (overrides or {}).items():
        data[table] = data.get(table, {}) | settings if isinstance(settings, dict) else settings
    data.setdefault("name", path.stem)
    return make_place(data, str(path)), path.parent


def make_place(data: dict[str, Any], source: str) -> Place:
    """Make a place from plain data, as a file holds it, and check it; ``source`` names it in messages.

    Raises:
        TrafficError: a value is invalid; one line.
    """
    try:
        return Place.model_validate(data)
    except pydantic.ValidationError as error:
        raise TrafficError(describe_error(source, error, Place)) from None

"""Places: a road network, its travel demand and its devices, read from TOML; every value is checked."""

import os
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import pydantic
from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from uavmec_jax.env.params import MAX_DEVICES
from uavmec_jax.errors import TrafficError
from uavmec_jax.files.parsing import parse_toml
from uavmec_jax.files.reading import read_text
from uavmec_jax.files.validation import PrintableText, StrictModel, from_array, suggest, validated
from uavmec_jax.traffic.sites import Sites, check_sites, refuse_degrees

MAX_TRIPS = 2_000_000
"""Most trips of one simulation: an evacuation of the most vehicles, and as many that pass through."""


def _check_path(path: str) -> str:
    if "\0" in path:
        raise PydanticCustomError("path", "Input should be a path without NUL characters")
    return path


_Positive = Annotated[float, Field(gt=0, le=1e7)]
_NotNegative = Annotated[float, Field(ge=0, le=1e7)]
_FilePath = Annotated[str, Field(min_length=1, max_length=4096), AfterValidator(_check_path)]

PLACES = resources.files("uavmec_jax.traffic") / "places"


def shipped_places() -> tuple[str, ...]:
    """Return the names of the places that ship with the package."""
    return tuple(sorted(folder.name for folder in PLACES.iterdir() if folder.is_dir()))


class NetworkSource(StrictModel):
    """The files that the roads come from, of one of three kinds. Paths are relative to the file of the place."""

    nodes: _FilePath | None = None
    """SUMO's plain XML, together with ``edges`` and ``types``."""
    edges: _FilePath | None = None
    types: _FilePath | None = None
    osm: _FilePath | None = None
    """An OpenStreetMap extract: .osm, .osm.gz or .osm.bz2."""
    bbox: Annotated[tuple[float, float, float, float] | None, from_array] = None
    """Part of the extract: west, south, east, north, in degrees."""
    net: _FilePath | None = None
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
    origins: Annotated[tuple[PrintableText, ...], Field(max_length=10_000), from_array] = ()
    """Roads where people live, weighted by their lengths; by default the residential roads."""
    exits: dict[PrintableText, _Positive] = Field(default_factory=dict, max_length=1000)
    """Junctions or roads where vehicles leave -> weight; by default the highway ends, weighted by lanes times speed."""
    rerouting: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Share of the drivers who look for a faster route on the way."""


class Simulation(StrictModel):
    """Settings of the simulations and of the averages over them."""

    seeds: Annotated[int, Field(ge=1, le=1000)] = 5
    duration_s: _Positive = 7200.0
    """Seconds simulated after the order to leave."""
    window_s: Annotated[float, Field(ge=1, le=1e7)] = 600.0
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
    description: PrintableText = ""
    network: NetworkSource
    demand: Demand = Demand()
    simulation: Simulation = Simulation()
    devices: Placement = Placement()
    device: Sites = ()

    @pydantic.model_validator(mode="before")
    @classmethod
    def _check_data(cls, data: Any) -> Any:
        return refuse_degrees(data)

    @pydantic.model_validator(mode="after")
    def _check(self) -> "Place":
        if self.device:
            check_sites(self.device)
        hours = (self.demand.warm_up_s + self.simulation.duration_s) / 3600
        if (trips := self.demand.vehicles + self.demand.through_per_hour * hours) > MAX_TRIPS:
            raise ValueError(
                f"demand.through_per_hour is {self.demand.through_per_hour:g}; in {hours:.3g} hours that makes {trips:.3g} "
                f"trips with the evacuated vehicles; give at most {MAX_TRIPS:,} trips"
            )
        return self


def file_of(source: str | Path, name: str) -> Path:
    """Return the file of this name of a shipped place; if there is no such place, ``source`` as the path of a file.

    Raises:
        TrafficError: it is neither.
    """
    path = Path(source)
    if str(source) in shipped_places():
        return Path(str(PLACES / str(source) / name))
    if not path.suffix and not os.path.lexists(path):
        raise TrafficError(f"{source}: neither a file nor a shipped place; {suggest(str(source), shipped_places())}")
    return path


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
    path = file_of(source, "place.toml")
    data = parse_toml(read_text(path, TrafficError), path, TrafficError)
    for table, settings in (overrides or {}).items():
        if not isinstance(settings, dict):
            data[table] = settings
        elif settings:
            given = data.get(table, {})
            data[table] = given | settings if isinstance(given, dict) else given
    data.setdefault("name", path.stem)
    return make_place(data, str(path)), path.parent


def make_place(data: dict[str, Any], source: str) -> Place:
    """Make a place from plain data, as a file holds it, and check it; ``source`` names it in messages.

    Raises:
        TrafficError: a value is invalid; one line.
    """
    return validated(Place, data, source, TrafficError)

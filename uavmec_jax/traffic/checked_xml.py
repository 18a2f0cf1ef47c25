"""Maps and road networks from outside, checked while they are copied to where SUMO may read them.

SUMO's own readers silently accept negative speeds, unknown elements and included files. A file that is refused here never
reaches them.
"""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from uavmec_jax.env.checks import MAX_LENGTH_M
from uavmec_jax.errors import TrafficError
from uavmec_jax.files.xml import CheckingHandler, RefusedError, copy_xml
from uavmec_jax.traffic.evacuation_schema import MAX_LANES

_ELEMENTS: Mapping[str, tuple[str, ...]] = {
    "osm": ("osm", "bounds", "note", "meta", "remark", "node", "way", "relation", "tag", "nd", "member"),
    "net": (
        *("net", "location", "type", "restriction", "edge", "lane", "stopOffset", "neigh", "param", "tlLogic", "phase"),
        *("junction", "request", "connection", "prohibition", "roundabout"),
    ),
    "nodes": ("nodes", "location", "node", "param"),
    "edges": ("edges", "edge", "lane", "param", "split", "neigh", "roundabout"),
    "types": ("types", "type", "restriction", "laneType", "param"),
}
"""Kind of file, which is the name of its root element -> the elements it may hold."""

_DESCRIPTIONS = {
    "osm": "an OpenStreetMap extract",
    "net": "a SUMO network",
    "nodes": "a file of nodes",
    "edges": "a file of edges",
    "types": "a file of road types",
}
_CONFIGURATIONS = ("configuration", "sumoConfiguration", "netconvertConfiguration")
_POSITIVE = ("speed", "length", "numLanes", "width")
_COORDINATES = ("x", "y", "z")
_UNIQUE = ("edge", "lane", "junction")
"""Elements of a network whose ids must differ; in files of nodes and edges, later elements change earlier ones."""

_OSM_LANES = ("lanes", "lanes:forward", "lanes:backward")


@dataclass
class Contents:
    """Summary of a checked file.

    Attributes:
        counts: element -> number of times it occurs.
        west, south, east, north: degrees, extent of the nodes of an OpenStreetMap extract.
    """

    counts: Counter[str] = field(default_factory=Counter)
    west: float = math.inf
    south: float = math.inf
    east: float = -math.inf
    north: float = -math.inf

    def overlaps(self, bbox: tuple[float, float, float, float]) -> bool:
        """Return whether a box ``(west, south, east, north)`` overlaps the extent."""
        return bbox[0] <= self.east and bbox[2] >= self.west and bbox[1] <= self.north and bbox[3] >= self.south

    def extend(self, lon: float, lat: float) -> None:
        """Extend the extent to a point."""
        self.west, self.east = min(self.west, lon), max(self.east, lon)
        self.south, self.north = min(self.south, lat), max(self.north, lat)


def checked_copy(source: Path, target: Path, kind: str) -> Contents:
    """Copy a file from outside, decompressed, and check it on the way.

    Args:
        source: plain, gzip or bzip2; its name does not matter.
        target: where SUMO may read it.
        kind: ``"osm"``, ``"net"``, ``"nodes"``, ``"edges"`` or ``"types"``.

    Raises:
        TrafficError: the file does not exist, is not XML, is truncated, too long or of another kind, declares a DTD or
            entities, or holds unknown elements or numbers out of range; one line.
    """
    handler = _Elements(kind)
    copy_xml(source, target, handler, TrafficError)
    return handler.contents


class _Elements(CheckingHandler):
    """Checks the root element, the names of the elements, and numbers."""

    def __init__(self, kind: str):
        super().__init__()
        self._kind = kind
        self._ids: set[tuple[str, str]] = set()
        self._way = ""
        self._empty_edge = ""
        self.contents = Contents()

    def check(self, name: str, attrs: Any) -> None:
        """Check the root element, the name of an element, and its numbers."""
        if not self.contents.counts:
            self._check_root(name)
        elif name not in _ELEMENTS[self._kind]:
            raise RefusedError(f"holds <{name}>, which is not an element of {_DESCRIPTIONS[self._kind]}")
        self.contents.counts[name] += 1
        if self._kind == "osm":
            self._check_map(name, attrs)
            return
        for quantity in _POSITIVE:
            if quantity in attrs:
                self._check_number(name, attrs, quantity)
        if self._kind == "net" and name in _UNIQUE:
            self._check_id(name, attrs)
            self._empty_edge = _label(name, attrs) if name == "edge" else ""
        if name in ("node", "junction"):
            for coordinate in _COORDINATES:
                if coordinate in attrs:
                    self._check_coordinates(name, attrs, coordinate)
        if "shape" in attrs:
            self._check_coordinates(name, attrs, "shape")

    def endElement(self, name: str) -> None:  # noqa: N802  (SAX's name)
        """Check that an edge of a network had a lane."""
        super().endElement(name)
        if name == "edge" and self._empty_edge:
            raise RefusedError(f"holds {self._empty_edge}, which has no lanes")

    def _check_root(self, name: str) -> None:
        if name in _CONFIGURATIONS:
            raise RefusedError(f"is a SUMO configuration, which is never run; give {_DESCRIPTIONS[self._kind]}")
        if name != self._kind:
            raise RefusedError(f"begins with <{name}>; {_DESCRIPTIONS[self._kind]} begins with <{self._kind}>")

    def _check_number(self, name: str, attrs: Any, quantity: str) -> None:
        try:
            value = float(attrs[quantity])
        except ValueError:
            value = math.nan
        if value == -1 and quantity in ("width", "length"):
            return  # SUMO writes -1 for "not given"
        if not 0 < value < 1e7:
            raise RefusedError(
                f"{quantity} of {_label(name, attrs)} is {attrs[quantity]!r}; it should be a number above 0"
            )
        if quantity == "numLanes" and value > MAX_LANES:
            raise RefusedError(f"numLanes of {_label(name, attrs)} is {attrs[quantity]!r}; give at most {MAX_LANES}")

    def _check_id(self, name: str, attrs: Any) -> None:
        """Check that an element of a network has an id of its own: of two equal ones, readers take one."""
        if not attrs.get("id"):
            raise RefusedError(f"has an element <{name}> without an id")
        if (name, attrs["id"]) in self._ids:
            raise RefusedError(f"holds {_label(name, attrs)} twice; ids must differ")
        self._ids.add((name, attrs["id"]))

    def _check_coordinates(self, name: str, attrs: Any, attribute: str) -> None:
        """Check that a coordinate, or each in a list of points ``x,y x,y``, is a number of metres on the Earth."""
        try:
            values = [float(value) for value in attrs[attribute].replace(",", " ").split()]
        except ValueError:
            values = [math.nan]
        if not all(abs(value) <= MAX_LENGTH_M for value in values):
            raise RefusedError(
                f"{attribute} of {_label(name, attrs)} is {attrs[attribute][:60]!r}; it should hold metres, numbers of at "
                f"most {MAX_LENGTH_M:g} in size"
            )

    def _check_map(self, name: str, attrs: Any) -> None:
        """Check an element of an OpenStreetMap extract: positions, and numbers of lanes that netconvert would build."""
        if name == "node":
            self._add_node(attrs)
        if name in ("node", "way", "relation"):
            self._way = attrs.get("id", "?") if name == "way" else ""
        elif name == "tag" and self._way and attrs.get("k") in _OSM_LANES:
            lanes = attrs.get("v", "").strip()
            if lanes.isdecimal() and (len(lanes) > 9 or int(lanes) > MAX_LANES):
                raise RefusedError(f"way {self._way}: {attrs['k']} is {lanes[:40]!r}; give at most {MAX_LANES}")

    def _add_node(self, attrs: Any) -> None:
        try:
            lon, lat = float(attrs["lon"]), float(attrs["lat"])
        except (KeyError, ValueError):
            raise RefusedError(f"node {attrs.get('id', '?')} has no lon and lat in degrees") from None
        if not (abs(lon) <= 180 and abs(lat) <= 90):
            raise RefusedError(f"node {attrs.get('id', '?')} lies at lon {lon}, lat {lat}, which is not on the Earth")
        self.contents.extend(lon, lat)


def _label(name: str, attrs: Any) -> str:
    """Return how messages name an element."""
    return f"{name} {attrs['id']!r}" if "id" in attrs else f"an element <{name}>"

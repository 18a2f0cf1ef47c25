"""Maps and networks from outside: checked while they are copied to where SUMO may read them.

SUMO's own readers load negative speeds, unknown elements and included files without a word. What is refused here never
reaches them.
"""

import bz2
import gzip
import math
import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any
from xml.sax import SAXParseException
from xml.sax.handler import ContentHandler

import defusedxml.sax
from defusedxml import DefusedXmlException

from uavmec_jax.errors import TrafficError

MOST_BYTES = 4 * 2**30
"""Longest file, decompressed; a compressed file of a few kilobytes can claim any length."""

_KNOWN: Mapping[str, tuple[str, ...]] = {
    "osm": ("osm", "bounds", "note", "meta", "remark", "node", "way", "relation", "tag", "nd", "member"),
    "net": (
        *("net", "location", "type", "restriction", "edge", "lane", "stopOffset", "neigh", "param", "tlLogic", "phase"),
        *("junction", "request", "connection", "prohibition", "roundabout"),
    ),
    "nodes": ("nodes", "location", "node", "param"),
    "edges": ("edges", "edge", "lane", "param", "split", "neigh", "roundabout"),
    "types": ("types", "type", "restriction", "laneType", "param"),
}
"""Root element of a kind of file -> the elements it may hold."""

_SPOKEN = {
    "osm": "an OpenStreetMap extract",
    "net": "a SUMO network",
    "nodes": "a file of nodes",
    "edges": "a file of edges",
    "types": "a file of road types",
}
_CONFIGURATIONS = ("configuration", "sumoConfiguration", "netconvertConfiguration")
_POSITIVE = ("speed", "length", "numLanes", "width")


@dataclass
class Contents:
    """What a file was found to hold.

    Attributes:
        counts: element -> how many.
        west, south, east, north: degrees, of the nodes of an OpenStreetMap extract.
    """

    counts: Counter[str] = field(default_factory=Counter)
    west: float = math.inf
    south: float = math.inf
    east: float = -math.inf
    north: float = -math.inf

    def overlaps(self, bbox: tuple[float, float, float, float]) -> bool:
        """Whether a box ``(west, south, east, north)`` holds any of it."""
        return bbox[0] <= self.east and bbox[2] >= self.west and bbox[1] <= self.north and bbox[3] >= self.south


def checked_copy(source: Path, target: Path, kind: str) -> Contents:
    """Copy a file from outside, decompressed, checking it on the way.

    Args:
        source: plain, gzip or bzip2, whatever it is called.
        target: where SUMO may read it.
        kind: ``"osm"``, ``"net"``, ``"nodes"``, ``"edges"`` or ``"types"``.

    Raises:
        TrafficError: it is not there, not XML, truncated, too long, something else, declares a DTD or entities, or holds
            unknown elements or numbers that make no sense; one line.
    """
    handler = _Checks(kind)
    try:
        with source.open("rb") as raw, target.open("wb") as copy:
            defusedxml.sax.parse(_Tee(_decompressed(raw), copy), handler, forbid_dtd=True)
    except DefusedXmlException:
        raise TrafficError(f"{source}: declares a DTD or entities, which are refused; export it without them") from None
    except SAXParseException as error:
        where = f"line {error.getLineNumber()}: {error.getMessage()}"
        raise TrafficError(f"{source}: is not XML, or is truncated ({where})") from None
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise TrafficError(f"{source}: is truncated or damaged: {error}") from None
    except UnicodeError as error:
        raise TrafficError(f"{source}: is not XML: {error}") from None
    except _RefusedError as error:
        raise TrafficError(f"{source}: {error}") from None
    except OSError as error:
        raise TrafficError(f"{source}: cannot be read: {error.strerror or error}") from None
    return handler.contents


class _RefusedError(Exception):
    """A file holds what it should not."""


def _decompressed(raw: IO[bytes]) -> Any:
    magic = raw.read(3)
    raw.seek(0)
    if magic[:2] == b"\x1f\x8b":
        return gzip.GzipFile(fileobj=raw)
    return bz2.BZ2File(raw) if magic == b"BZh" else raw


class _Tee:
    """Reads a file and writes what was read to another one."""

    def __init__(self, source: Any, copy: IO[bytes]):
        self._source, self._copy, self._bytes = source, copy, 0

    def read(self, size: int = -1) -> bytes:
        chunk: bytes = self._source.read(size)
        self._bytes += len(chunk)
        if self._bytes > MOST_BYTES:
            raise _RefusedError(f"is longer than {MOST_BYTES / 2**30:g} GiB; cut it to the town first")
        self._copy.write(chunk)
        return chunk

    def close(self) -> None:
        """The files are closed by whoever opened them."""


class _Checks(ContentHandler):
    """Root, elements and numbers."""

    def __init__(self, kind: str):
        super().__init__()
        self._kind = kind
        self.contents = Contents()

    def startElement(self, name: str, attrs: Any) -> None:  # noqa: N802  (the name SAX calls)
        if not self.contents.counts:
            self._check_root(name)
        elif name not in _KNOWN[self._kind]:
            raise _RefusedError(f"holds <{name}>, which is not an element of {_SPOKEN[self._kind]}")
        self.contents.counts[name] += 1
        if self._kind == "osm":
            if name == "node":
                self._place(attrs)
            return
        for quantity in _POSITIVE:
            if quantity in attrs:
                self._check_number(name, attrs, quantity)

    def _check_root(self, name: str) -> None:
        if name in _CONFIGURATIONS:
            raise _RefusedError(f"is a SUMO configuration, which is never run; give {_SPOKEN[self._kind]}")
        if name != self._kind:
            raise _RefusedError(f"begins with <{name}>; {_SPOKEN[self._kind]} begins with <{self._kind}>")

    def _check_number(self, name: str, attrs: Any, quantity: str) -> None:
        try:
            value = float(attrs[quantity])
        except ValueError:
            value = math.nan
        if value == -1 and quantity in ("width", "length"):
            return  # SUMO's word for "not given"
        if not 0 < value < 1e7:
            who = f"{name} {attrs['id']!r}" if "id" in attrs else f"a {name}"
            raise _RefusedError(f"{quantity} of {who} is {attrs[quantity]!r}; it should be a number above 0")

    def _place(self, attrs: Any) -> None:
        try:
            lon, lat = float(attrs["lon"]), float(attrs["lat"])
        except (KeyError, ValueError):
            raise _RefusedError(f"node {attrs.get('id', '?')} has no lon and lat in degrees") from None
        if not (abs(lon) <= 180 and abs(lat) <= 90):
            raise _RefusedError(f"node {attrs.get('id', '?')} lies at lon {lon}, lat {lat}, which is not on the Earth")
        found = self.contents
        found.west, found.east = min(found.west, lon), max(found.east, lon)
        found.south, found.north = min(found.south, lat), max(found.north, lat)

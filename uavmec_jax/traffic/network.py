"""Road networks: made by netconvert from checked sources, kept by their hash, and read back as roads and junctions."""

import contextlib
import hashlib
import re
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from uavmec_jax.errors import TrafficError
from uavmec_jax.files.writing import atomic
from uavmec_jax.traffic import sumo
from uavmec_jax.traffic.checked_xml import Contents, checked_copy
from uavmec_jax.traffic.place import NetworkSource
from uavmec_jax.traffic.workspace import Workshop

HIGHWAYS = ("motorway", "motorway_link", "trunk", "trunk_link", "primary")
"""Classes of roads whose ends are exits, unless the user names the exits."""

RESIDENTIAL = ("residential", "living_street", "unclassified")
"""Classes of roads where people live; the first ones that a network has."""

_BUILD_LIMIT_S = 900.0
_PLAIN = ("nodes", "edges", "types")
_PLAIN_OPTIONS = ("--offset.disable-normalization", "true")
_OSM_OPTIONS = (
    *("--keep-edges.by-vclass", "passenger", "--remove-edges.isolated", "true", "--geometry.remove", "true"),
    *("--junctions.join", "true", "--tls.guess-signals", "true", "--tls.discard-simple", "true"),
    *("--output.street-names", "true", "--no-turnarounds.except-deadend", "true"),
)


@dataclass(frozen=True)
class Road:
    """One direction of a road between two junctions; ``shape`` is ``[k, 2]`` m, ``name`` may be empty."""

    id: str
    name: str
    kind: str
    lanes: int
    speed_m_s: float
    length_m: float
    start: str
    end: str
    shape: np.ndarray


@dataclass(frozen=True)
class RoadNetwork:
    """Roads that cars may use, and the junctions between them.

    Attributes:
        roads: by id, in the order of the file.
        onward: road -> the roads that one can turn into at its end.
        junctions: id -> ``(x, y)`` m.
        sha256: of the network file without its comments.
        file: where it is.
    """

    roads: dict[str, Road]
    onward: dict[str, tuple[str, ...]]
    junctions: dict[str, tuple[float, float]]
    sha256: str
    file: Path

    @cached_property
    def backward(self) -> dict[str, list[str]]:
        """Road -> the roads that lead into it."""
        found: dict[str, list[str]] = {road: [] for road in self.roads}
        for road, nexts in self.onward.items():
            for after in nexts:
                found[after].append(road)
        return found

    @cached_property
    def shapes(self) -> list[np.ndarray]:
        """The shape of each road, ``[k, 2]`` m."""
        return [road.shape for road in self.roads.values()]

    @cached_property
    def lanes(self) -> np.ndarray:
        """``[R]`` lanes of each road."""
        return np.array([road.lanes for road in self.roads.values()])

    def leading_to(self, road: str) -> set[str]:
        """The roads from which a car can reach a road, itself among them."""
        found, frontier = {road}, [road]
        while frontier:
            for before in self.backward[frontier.pop()]:
                if before not in found:
                    found.add(before)
                    frontier.append(before)
        return found

    def into(self, junction: str) -> list[Road]:
        """The roads that end at a junction, the widest first."""
        return sorted((road for road in self.roads.values() if road.end == junction), key=lambda road: -road.lanes)

    def streets_at(self, junction: str) -> list[str]:
        """Names of the roads that meet at a junction, each once."""
        named = (road.name for road in self.roads.values() if junction in (road.start, road.end) and road.name)
        return list(dict.fromkeys(named))

    def is_end(self, road: Road) -> bool:
        """Whether nothing but the way back goes on from a road."""
        return all(self.roads[after].end == road.start for after in self.onward[road.id])

    def is_beginning(self, road: Road) -> bool:
        """Whether nothing but its own opposite leads into a road."""
        return all(self.roads[before].start == road.end for before in self.backward[road.id])

    def of_kind(self, kinds: Iterable[str]) -> list[Road]:
        """Roads of some classes."""
        wanted = set(kinds)
        return [road for road in self.roads.values() if road.kind in wanted]


def build_network(source: NetworkSource, folder: Path, workshop: Workshop) -> RoadNetwork:
    """The network of a place, checked, built if this machine has not built it before.

    Args:
        source: where it comes from.
        folder: that relative paths start from.
        workshop: where it is worked on.

    Raises:
        TrafficError: a file is not usable, SUMO is missing or fails, or there are no roads or junctions.
    """
    target = workshop.folder / "network.net.xml"
    if source.net is not None:
        checked_copy(folder / source.net, target, "net")
        return read_network(target, str(source.net))
    name, options = _prepare(source, folder, workshop)
    command: list[str | Path] = [sumo.program("netconvert"), *options, "--output-file", target]
    kept = _kept(options, workshop)
    if kept.is_file():
        shutil.copyfile(kept, target)
    else:
        try:
            workshop.run("netconvert", command, limit_s=_BUILD_LIMIT_S, env=sumo.environment())
        except TrafficError as error:
            raise TrafficError(f"{name}: {error}") from None
        _keep(target, kept)
    return read_network(target, name)


def _prepare(source: NetworkSource, folder: Path, workshop: Workshop) -> tuple[str, list[str]]:
    """Check the sources into the workshop; their name for messages and netconvert's options."""
    if source.osm is not None:
        path = folder / source.osm
        found = checked_copy(path, workshop.folder / "map.osm.xml", "osm")
        options = ["--osm-files", "map.osm.xml", *_OSM_OPTIONS]
        if not found.counts["way"]:
            raise TrafficError(f"{path}: holds no roads and no junctions ({found.counts['node']} nodes, 0 ways)")
        if source.bbox is not None:
            _check_box(path, source.bbox, found)
            options += ["--keep-edges.in-geo-boundary", ",".join(map(str, source.bbox))]
        return str(path), options
    options = list(_PLAIN_OPTIONS)
    for kind in _PLAIN:
        checked_copy(folder / str(getattr(source, kind)), workshop.folder / f"plain.{kind}.xml", kind)
        options += [f"--{kind[:-1]}-files", f"plain.{kind}.xml"]
    return str(folder / str(source.edges)), options


def _check_box(path: Path, bbox: tuple[float, float, float, float], found: Contents) -> None:
    if not found.overlaps(bbox):
        raise TrafficError(
            f"{path}: the bounding box {','.join(f'{side:g}' for side in bbox)} lies outside the extract, which spans "
            f"{found.west:.4f},{found.south:.4f},{found.east:.4f},{found.north:.4f} (west,south,east,north)"
        )


def _kept(options: list[str], workshop: Workshop) -> Path:
    """Where a network with this source, these options and this version of SUMO is kept."""
    digest = hashlib.sha256("\n".join([sumo.version(), *options]).encode())
    for option in options:
        if option.endswith(".xml"):
            digest.update((workshop.folder / option).read_bytes())
    return Path(platformdirs.user_cache_dir("uavmec-jax")) / "networks" / f"{digest.hexdigest()}.net.xml"


def _keep(built: Path, kept: Path) -> None:
    """Keep a network for the next time; where that cannot be, there is no next time."""
    with contextlib.suppress(OSError):
        kept.parent.mkdir(parents=True, exist_ok=True)
        with atomic(kept) as partial:
            shutil.copyfile(built, partial)


def read_network(file: Path, name: str) -> RoadNetwork:
    """Roads and junctions of a checked network file; ``name`` stands for it in messages.

    Raises:
        TrafficError: SUMO is missing, or there are no roads or junctions.
    """
    try:
        net = sumo.read_network(file)
    except TrafficError as error:
        raise TrafficError(f"{name}: {error}") from None
    roads = {edge.getID(): _road(edge) for edge in net.getEdges() if edge.allows("passenger")}
    onward = {
        edge.getID(): tuple(after.getID() for after in edge.getOutgoing() if after.getID() in roads)
        for edge in net.getEdges()
        if edge.getID() in roads
    }
    used = {end for road in roads.values() for end in (road.start, road.end)}
    junctions = {node.getID(): node.getCoord()[:2] for node in net.getNodes() if node.getID() in used}
    if not roads or len(junctions) < 2:
        raise TrafficError(f"{name}: has no junctions with roads for cars between them")
    return RoadNetwork(roads, onward, junctions, _digest(file), file)


def _digest(file: Path) -> str:
    """SHA-256 of a network without its comments: netconvert writes the date of the day into one."""
    return hashlib.sha256(re.sub(rb"<!--.*?-->", b"", file.read_bytes(), flags=re.DOTALL)).hexdigest()


def _road(edge: Any) -> Road:
    return Road(
        id=edge.getID(),
        name=edge.getName() or "",
        kind=(edge.getType() or "").split("|")[0].rpartition(".")[2],
        lanes=edge.getLaneNumber(),
        speed_m_s=edge.getSpeed(),
        length_m=edge.getLength(),
        start=edge.getFromNode().getID(),
        end=edge.getToNode().getID(),
        shape=np.array([point[:2] for point in edge.getShape()], float),
    )

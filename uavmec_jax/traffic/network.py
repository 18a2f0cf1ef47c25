"""Road networks: built by netconvert from checked sources, cached by their hash, and read as roads and junctions."""

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
from jaxtyping import Float, Int

from uavmec_jax.env.checks import MAX_LENGTH_M
from uavmec_jax.errors import TrafficError
from uavmec_jax.files import xml
from uavmec_jax.files.reading import read_bytes
from uavmec_jax.files.writing import atomic
from uavmec_jax.traffic import sumo
from uavmec_jax.traffic.checked_xml import Contents, checked_copy
from uavmec_jax.traffic.evacuation_schema import MAX_LANES, MAX_ROADS
from uavmec_jax.traffic.place import NetworkSource
from uavmec_jax.traffic.workspace import Workspace

HIGHWAYS = ("motorway", "motorway_link", "trunk", "trunk_link", "primary")
"""Classes of roads whose ends are exits, unless the user names the exits."""

RESIDENTIAL = ("residential", "living_street", "unclassified")
"""Classes of roads where people live, in order of preference: the first class that a network has is used."""

_BUILD_LIMIT_S = 900.0
_MAX_ID = 1000
_PLAIN = ("nodes", "edges", "types")
_PLAIN_OPTIONS = ("--offset.disable-normalization", "true")
_OSM_OPTIONS = (
    *("--keep-edges.by-vclass", "passenger", "--remove-edges.isolated", "true", "--geometry.remove", "true"),
    *("--junctions.join", "true", "--tls.guess-signals", "true", "--tls.discard-simple", "true"),
    *("--output.street-names", "true", "--no-turnarounds.except-deadend", "true"),
)


@dataclass(frozen=True)
class Road:
    """One direction of a road between two junctions.

    Attributes:
        id: SUMO's id of the edge.
        name: of the street; may be empty.
        road_class: OpenStreetMap's class, e.g. ``residential``.
        lanes: number of lanes.
        speed_m_s: speed limit.
        length_m: as SUMO has it.
        start, end: ids of the junctions.
        shape: ``[k, 2]`` m, its corners.
    """

    id: str
    name: str
    road_class: str
    lanes: int
    speed_m_s: float
    length_m: float
    start: str
    end: str
    shape: Float[np.ndarray, "k 2"]


@dataclass(frozen=True)
class RoadNetwork:
    """Roads that cars may use, and the junctions between them.

    Attributes:
        roads: by id, in the order of the file.
        successors: road -> the roads that one can turn into at its end.
        junctions: id -> ``(x, y)`` m.
        sha256: of the network file without its comments.
        file: the network file.
    """

    roads: dict[str, Road]
    successors: dict[str, tuple[str, ...]]
    junctions: dict[str, tuple[float, float]]
    sha256: str
    file: Path

    @cached_property
    def predecessors(self) -> dict[str, list[str]]:
        """Road -> the roads that lead into it."""
        predecessors: dict[str, list[str]] = {road: [] for road in self.roads}
        for road, successors in self.successors.items():
            for successor in successors:
                predecessors[successor].append(road)
        return predecessors

    @cached_property
    def shapes(self) -> list[np.ndarray]:
        """Corners of each road, ``[k, 2]`` m."""
        return [road.shape for road in self.roads.values()]

    @cached_property
    def lanes(self) -> Int[np.ndarray, " R"]:
        """``[R]`` number of lanes of each road."""
        return np.array([road.lanes for road in self.roads.values()])

    def roads_reaching(self, road: str) -> set[str]:
        """Return the roads from which a car can reach a road, including the road itself."""
        reaching, frontier = {road}, [road]
        while frontier:
            for predecessor in self.predecessors[frontier.pop()]:
                if predecessor not in reaching:
                    reaching.add(predecessor)
                    frontier.append(predecessor)
        return reaching

    def roads_into(self, junction: str) -> list[Road]:
        """Return the roads that end at a junction, the widest first."""
        return sorted((road for road in self.roads.values() if road.end == junction), key=lambda road: -road.lanes)

    def streets_at(self, junction: str) -> list[str]:
        """Return the names of the streets that meet at a junction, each once."""
        names = (road.name for road in self.roads.values() if junction in (road.start, road.end) and road.name)
        return list(dict.fromkeys(names))

    def is_sink(self, road: Road) -> bool:
        """Return whether a road ends without a way on, other than its own opposite direction."""
        return all(self.roads[successor].end == road.start for successor in self.successors[road.id])

    def is_source(self, road: Road) -> bool:
        """Return whether no road leads into a road, other than its own opposite direction."""
        return all(self.roads[predecessor].start == road.end for predecessor in self.predecessors[road.id])

    def of_class(self, road_classes: Iterable[str]) -> list[Road]:
        """Return the roads of some classes."""
        wanted = set(road_classes)
        return [road for road in self.roads.values() if road.road_class in wanted]


def build_network(source: NetworkSource, folder: Path, workspace: Workspace) -> RoadNetwork:
    """Check the sources of a network and build it, unless this machine has it in its cache.

    Args:
        source: the files of the network.
        folder: relative paths start from here.
        workspace: where it is built.

    Raises:
        TrafficError: a file is not usable, SUMO is missing or fails, or there are no roads or junctions.
    """
    target = workspace.folder / "network.net.xml"
    if source.net is not None:
        checked_copy(folder / source.net, target, "net")
        return read_network(target, str(source.net))
    name, options = _copy_sources(source, folder, workspace)
    command: list[str | Path] = [sumo.program("netconvert"), *options, "--output-file", target]
    cached = _cache_path(options, workspace)
    if cached.is_file():
        shutil.copyfile(cached, target)
    else:
        try:
            workspace.run("netconvert", command, limit_s=_BUILD_LIMIT_S, env=sumo.environment())
        except TrafficError as error:
            raise TrafficError(f"{name}: {error}") from None
        _store_in_cache(target, cached)
    return read_network(target, name)


def _copy_sources(source: NetworkSource, folder: Path, workspace: Workspace) -> tuple[str, list[str]]:
    """Copy the checked sources into the workspace; return their name for messages, and netconvert's options."""
    if source.osm is not None:
        path = folder / source.osm
        contents = checked_copy(path, workspace.folder / "map.osm.xml", "osm")
        options = ["--osm-files", "map.osm.xml", *_OSM_OPTIONS]
        if not contents.counts["way"]:
            raise TrafficError(f"{path}: holds no roads and no junctions ({contents.counts['node']} nodes, 0 ways)")
        if source.bbox is not None:
            _check_box(path, source.bbox, contents)
            options += ["--keep-edges.in-geo-boundary", ",".join(map(str, source.bbox))]
        return str(path), options
    options = list(_PLAIN_OPTIONS)
    for kind in _PLAIN:
        checked_copy(folder / str(getattr(source, kind)), workspace.folder / f"plain.{kind}.xml", kind)
        options += [f"--{kind[:-1]}-files", f"plain.{kind}.xml"]
    return str(folder / str(source.edges)), options


def _check_box(path: Path, bbox: tuple[float, float, float, float], contents: Contents) -> None:
    if not contents.overlaps(bbox):
        extent = f"{contents.west:.4f},{contents.south:.4f},{contents.east:.4f},{contents.north:.4f}"
        raise TrafficError(
            f"{path}: the bounding box {','.join(f'{side:g}' for side in bbox)} lies outside the extract, which spans "
            f"{extent} (west,south,east,north)"
        )


def _cache_path(options: list[str], workspace: Workspace) -> Path:
    """Return where a network with these sources, these options and this version of SUMO is cached."""
    digest = hashlib.sha256("\n".join([sumo.version(), *options]).encode())
    for option in options:
        if option.endswith(".xml"):
            digest.update(read_bytes(workspace.folder / option, TrafficError, max_bytes=xml.MAX_BYTES))
    return Path(platformdirs.user_cache_dir("uavmec-jax")) / "networks" / f"{digest.hexdigest()}.net.xml"


def _store_in_cache(network: Path, cached: Path) -> None:
    """Copy a network into the cache; do nothing where the cache cannot be written."""
    with contextlib.suppress(OSError):
        cached.parent.mkdir(parents=True, exist_ok=True)
        with atomic(cached) as partial:
            shutil.copyfile(network, partial)


def read_network(file: Path, name: str) -> RoadNetwork:
    """Read the roads and junctions of a checked network file; ``name`` stands for it in messages.

    Raises:
        TrafficError: SUMO is missing, the network holds a road that no car can drive on, or there are no roads or junctions.
    """
    try:
        net = sumo.read_network(file)
        roads = {edge.getID(): _make_road(edge) for edge in net.getEdges() if edge.allows("passenger")}
    except TrafficError as error:
        raise TrafficError(f"{name}: {error}") from None
    successors = {
        edge.getID(): tuple(after.getID() for after in edge.getOutgoing() if after.getID() in roads)
        for edge in net.getEdges()
        if edge.getID() in roads
    }
    used = {end for road in roads.values() for end in (road.start, road.end)}
    junctions = {node.getID(): node.getCoord()[:2] for node in net.getNodes() if node.getID() in used}
    if not roads or len(junctions) < 2:
        raise TrafficError(f"{name}: has no junctions with roads for cars between them")
    if len(roads) > MAX_ROADS:
        raise TrafficError(f"{name}: has {len(roads):,} roads; cut out an area with at most {MAX_ROADS:,}")
    return RoadNetwork(roads, successors, junctions, _digest(file), file)


def _digest(file: Path) -> str:
    """Return the SHA-256 of a network without its comments, one of which holds the date on which it was built."""
    content = read_bytes(file, TrafficError, max_bytes=xml.MAX_BYTES)
    return hashlib.sha256(re.sub(rb"<!--.*?-->", b"", content, flags=re.DOTALL)).hexdigest()


def _make_road(edge: Any) -> Road:
    """Make a road of an edge of sumolib's, which takes what it is given.

    Raises:
        TrafficError: a junction at its ends does not exist, or its id, lanes or shape are not those of a road.
    """
    label = f"edge {edge.getID()!r}"
    if not edge.getID().isprintable() or len(edge.getID()) > _MAX_ID:
        raise TrafficError(f"{label}: its id should be at most {_MAX_ID} characters that can be printed")
    for verb, node in (("begins", edge.getFromNode()), ("ends", edge.getToNode())):
        if node is None:
            raise TrafficError(f"{label}: {verb} at no junction; give from and to")
        if node.getCoord3D() is None:  # sumolib has made it up
            raise TrafficError(f"{label}: {verb} at junction {node.getID()!r}, which does not exist")
        _check_points([node.getCoord()[:2]], f"junction {node.getID()!r}")
    if edge.getLaneNumber() > MAX_LANES:
        raise TrafficError(f"{label}: has {edge.getLaneNumber()} lanes; give at most {MAX_LANES}")
    if any(len(lane.getShape()) < 2 for lane in edge.getLanes()):
        raise TrafficError(f"{label}: has a lane without a shape; give at least two points")
    return Road(
        id=edge.getID(),
        name=edge.getName() or "",
        road_class=(edge.getType() or "").split("|")[0].rpartition(".")[2],
        lanes=edge.getLaneNumber(),
        speed_m_s=edge.getSpeed(),
        length_m=edge.getLength(),
        start=edge.getFromNode().getID(),
        end=edge.getToNode().getID(),
        shape=_check_points([point[:2] for point in edge.getShape()], label),
    )


def _check_points(points: list[Any], label: str) -> Float[np.ndarray, "k 2"]:
    """Return points as an array, after checking that they are metres on the Earth."""
    shape = np.array(points, float)
    if not (np.abs(shape) <= MAX_LENGTH_M).all():
        raise TrafficError(f"{label}: has a coordinate that is not a number of metres up to {MAX_LENGTH_M:g}")
    return shape

"""Where things are: positions of a scenario file in metres, its region, and the polygon that bounds it."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from uavmec_jax.env.params import Params
from uavmec_jax.scenarios.schema import Located, ScenarioFile, label

_EARTH_RADIUS_M = 6_371_008.8
_TOLERANCE = 1e-6
"""Share of the region's extent by which a position may lie outside."""
_MAX_CORNERS = 1000


class Positions(NamedTuple):
    """Positions of a scenario file, m from the origin.

    Attributes:
        devices: of the devices.
        depots: of the depots.
        starts: of the UAVs in the file.
        corners: of the region, if it is a polygon.
        origin: longitude and latitude of the origin, if they are known.
    """

    devices: Float[np.ndarray, "n 2"]
    depots: Float[np.ndarray, "D 2"]
    starts: Float[np.ndarray, "K 2"]
    corners: Float[np.ndarray, "m 2"] | None
    origin: tuple[float, float] | None

    @property
    def places(self) -> Float[np.ndarray, "n_places 2"]:
        """Positions of the devices, then of the depots."""
        return np.concatenate([self.devices, self.depots])


def metres_per_degree(latitude: float) -> Float[np.ndarray, "2"]:
    """Return metres per degree of longitude and of latitude (equirectangular: exact enough within a city)."""
    per_degree = math.radians(1.0) * _EARTH_RADIUS_M
    return np.array([per_degree * math.cos(math.radians(latitude)), per_degree])


def find_positions(file: ScenarioFile) -> Positions:
    """Return all positions in metres.

    Raises:
        ValueError: a position is missing, unclear or in other coordinates than the first device; one line that names it.
    """
    placed = _placed(file)
    in_degrees = _check_coordinates(placed)
    given = np.array([[it.lon, it.lat] if in_degrees else [it.x_m, it.y_m] for *_, it in placed], float)
    corners = None if file.region is None else np.array(file.region, float).reshape(-1, 2)
    origin = file.origin
    if in_degrees:
        middle = given[0, 0] if origin is None else origin[0]
        given, corners = _unwrapped(given, middle), None if corners is None else _unwrapped_corners(corners, middle)
    corners = None if corners is None else _check_polygon(corners)
    if in_degrees:
        west, south = origin or (float(side) for side in (given if corners is None else corners).min(axis=0))
        origin, scale = (float(wrap_longitudes(np.array(west))), south), metres_per_degree(south)
        given = (given - (west, south)) * scale
        corners = None if corners is None else (corners - (west, south)) * scale
    devices, depots, starts = np.split(given, [len(file.device), len(file.device) + len(file.depot)])
    return Positions(devices, depots, _starts(file, np.concatenate([devices, depots]), iter(starts)), corners, origin)


def wrap_longitudes(degrees: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return longitudes from -180 to 180; those that are there already stay as they are, to the bit."""
    return np.asarray(degrees - 360.0 * np.where(np.abs(degrees) > 180.0, np.round(degrees / 360.0), 0.0))


def _unwrapped(places: Float[np.ndarray, "p 2"], middle: float) -> Float[np.ndarray, "p 2"]:
    """Return longitudes and latitudes, the former within 180 degrees of one in their ``middle``, across the antimeridian."""
    around = 360.0 * np.round((places[:, 0] - middle) / 360.0)
    return places - np.stack([around, np.zeros_like(around)], axis=1)


def _unwrapped_corners(corners: Float[np.ndarray, "m 2"], middle: float) -> Float[np.ndarray, "m 2"]:
    """Check the corners of a region in degrees and return them unwrapped."""
    outside = np.any((corners < [-180.0, -89.0]) | (corners > [360.0, 89.0]), axis=1)
    if outside.any():
        number = int(np.argmax(outside))
        raise ValueError(
            f"region: corner {number + 1} is {corners[number].tolist()}; give [longitude, latitude] from -180 to 360 and "
            "from -89 to 89 degrees"
        )
    return _unwrapped(corners, middle)


def _placed(file: ScenarioFile) -> list[tuple[str, int, Located]]:
    """Return what has a position of its own, each with the name of its table and its number: devices, depots, then UAVs."""
    tables: tuple[tuple[str, Sequence[Located]], ...] = (
        ("device", file.device),
        ("depot", file.depot),
        ("uav", file.uav),
    )
    numbered = [(table, number, it) for table, its in tables for number, it in enumerate(its, 1)]
    return [(table, number, it) for table, number, it in numbered if table != "uav" or _has_coordinates(it)]


def _has_coordinates(it: Located) -> bool:
    return any(value is not None for value in (it.x_m, it.y_m, it.lon, it.lat))


def _check_coordinates(placed: list[tuple[str, int, Located]]) -> bool:
    """Check that all positions are clear and in the coordinates of the first device; return whether these are degrees."""
    first = placed[0][2]
    degrees = first.lon is not None and first.lat is not None
    for table, number, it in placed:
        in_metres = it.x_m is not None and it.y_m is not None
        in_degrees = it.lon is not None and it.lat is not None
        if in_metres == in_degrees or in_degrees != degrees:
            ways = "at, or x_m and y_m," if table == "uav" else "x_m and y_m,"
            raise ValueError(
                f"{label(table, number, it.name)}: position is unclear; give {ways} or lon and lat, the same for all"
            )
    return degrees


def _starts(
    file: ScenarioFile, places: Float[np.ndarray, "n_places 2"], given: Iterator[Float[np.ndarray, "2"]]
) -> Float[np.ndarray, "K 2"]:
    """Return where the UAVs start: where the file says, or at depot ``v mod D``, or at the origin."""
    names = file.place_names
    starts = np.zeros((len(file.uav), 2))
    for number, uav in enumerate(file.uav):
        where = label("uav", number + 1, uav.name)
        if uav.at is not None and _has_coordinates(uav):
            raise ValueError(f"{where}: at and coordinates are both given; leave one of them out")
        if uav.at is not None and uav.at not in names:
            raise ValueError(f"{where}: at is {uav.at!r}; the places are {', '.join(names)}")
        if uav.at is not None:
            starts[number] = places[names.index(uav.at)]
        elif _has_coordinates(uav):
            starts[number] = next(given)
        elif file.depot:
            starts[number] = places[len(file.device) + number % len(file.depot)]
    return starts


def check_inside(file: ScenarioFile, positions: Positions, params: Params) -> None:
    """Check that devices, depots and the starts that the file gives lie in the region.

    The default start, the origin, need not lie in a polygon.

    Raises:
        ValueError: something lies outside; one line that names it.
    """
    placed = _placed(file)
    given = np.array([_has_coordinates(uav) for uav in file.uav], bool)
    points = np.concatenate([positions.places, positions.starts[given]])
    if positions.corners is None:
        east, north = params.region_m
        inside = (points >= 0).all(axis=1) & (points <= np.array([east, north]) * (1 + _TOLERANCE)).all(axis=1)
        where = f"the region of {east:g} x {north:g} m; move it or give a larger params.region_m"
    else:
        inside = inside_polygon(points, positions.corners, _TOLERANCE * float(np.ptp(positions.corners, axis=0).max()))
        where = "the polygon of region; move it or give a larger region"
    if not inside.all():
        table, number, it = placed[int(np.argmin(inside))]
        x, y = points[int(np.argmin(inside))]
        raise ValueError(f"{label(table, number, it.name)}: lies at {x:.0f}, {y:.0f} m, outside {where}")


def region_sides(positions: Positions) -> tuple[float, float]:
    """Return the sides in m of the smallest region from the origin on that holds everything, or the polygon if there is one.

    Raises:
        ValueError: a corner of the polygon lies south or west of the origin.
    """
    if positions.corners is None:
        held = np.concatenate([positions.places, positions.starts])
    else:
        held = positions.corners
        for number, (x, y) in enumerate(held, 1):
            if min(x, y) < 0:
                raise ValueError(
                    f"region: corner {number} lies at {x:.0f}, {y:.0f} m; give corners north and east of the origin"
                )
    east, north = np.maximum(held.max(axis=0), 1.0)
    return float(east), float(north)


def _check_polygon(corners: Float[np.ndarray, "given 2"]) -> Float[np.ndarray, "m 2"]:
    """Return the corners of a simple polygon, each of them once; the last one may repeat the first."""
    if len(corners) > 1 and np.array_equal(corners[0], corners[-1]):
        corners = corners[:-1]
    if not 3 <= len(corners) <= _MAX_CORNERS:
        raise ValueError(f"region has {len(corners)} different corners; give 3 to {_MAX_CORNERS}")
    along = np.roll(corners, -1, axis=0) - corners
    area = abs(np.sum(_cross(corners - corners[0], along))) / 2
    if area <= 1e-9 * np.sum(np.hypot(*along.T)) ** 2:
        raise ValueError("region has no area; give the corners in order, around it")
    if (crossing := _crossing_sides(corners, along)) is not None:
        here, there = crossing
        raise ValueError(
            f"region: the sides from corners {here + 1} and {there + 1} meet; give the corners in order, around it"
        )
    return corners


def _crossing_sides(corners: Float[np.ndarray, "m 2"], along: Float[np.ndarray, "m 2"]) -> tuple[int, int] | None:
    """Return the first two sides of a polygon that meet elsewhere than in the corner between them; ``None`` if none do."""
    ends, count = corners + along, len(corners)
    # Two segments meet if each has the other's ends on both sides of its line, and the boxes around them meet.
    towards = _cross(along[:, None], corners[None] - corners[:, None])
    beyond = _cross(along[:, None], ends[None] - corners[:, None])
    straddles = towards * beyond <= 0
    low, high = np.minimum(corners, ends), np.maximum(corners, ends)
    boxes_meet = (low[:, None] <= high[None]).all(axis=-1) & (low[None] <= high[:, None]).all(axis=-1)
    first, second = np.indices((count, count))
    apart = (second - first) % count
    neighbours = (apart == 1) | (apart == count - 1)
    in_line = np.abs(towards) + np.abs(beyond) <= 1e-12 * np.sum(np.ptp(corners, axis=0)) ** 2
    folds_back = in_line & (along @ along.T <= 0)
    meet = np.where(neighbours, folds_back, straddles & straddles.T & boxes_meet) & (second > first)
    return None if not meet.any() else divmod(int(np.argmax(meet)), count)


def inside_polygon(
    points: Float[np.ndarray, "p 2"], corners: Float[np.ndarray, "m 2"], tolerance: float
) -> Bool[np.ndarray, " p"]:
    """Return whether points lie in a simple polygon, or at most ``tolerance`` away from one of its sides."""
    along = np.roll(corners, -1, axis=0) - corners
    off = points[:, None] - corners
    # A point is inside if a ray to the east crosses an odd number of sides.
    spans = (off[..., 1] < 0) != (off[..., 1] < along[:, 1])
    crossing = off[..., 1] * along[:, 0] / np.where(along[:, 1] == 0, 1.0, along[:, 1])
    inside = np.sum(spans & (off[..., 0] < crossing), axis=1) % 2 == 1
    share = np.clip(np.sum(off * along, axis=-1) / np.sum(along**2, axis=-1), 0.0, 1.0)
    distance = np.hypot(*np.moveaxis(off - share[..., None] * along, -1, 0))
    return inside | np.any(distance <= tolerance, axis=1)


def _cross(a: Float[np.ndarray, "*#s 2"], b: Float[np.ndarray, "*#s 2"]) -> Float[np.ndarray, "..."]:
    """Return the cross products of vectors."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]

"""Lines and polygons of maps that cross the antimeridian, cut there as GeoJSON wants it (RFC 7946, section 3.1.9)."""

import itertools
from typing import Any

import numpy as np
from jaxtyping import Float


def line_geometry(places: Float[np.ndarray, "p 2"]) -> tuple[str, list[Any]]:
    """Return the type and the coordinates of a line through longitudes, from -180 to 180, and latitudes."""
    line = _continuous(places)
    world = _world(line[0, 0], line[1, 0])
    parts: list[list[list[float]]] = [[_on_map(line[0], world)]]
    for here, there in itertools.pairwise(line):
        while (step := int(np.sign(_world(there[0], here[0]) - world))) != 0:
            crossing = _crossing(here, there, 360.0 * world + 180.0 * step)
            parts[-1].append(_on_map(crossing, world))
            world += step
            parts.append([_on_map(crossing, world)])
        parts[-1].append(_on_map(there, world))
    return ("LineString", parts[0]) if len(parts) == 1 else ("MultiLineString", parts)


def polygon_geometry(corners: Float[np.ndarray, "m 2"]) -> tuple[str, list[Any]]:
    """Return the type and the coordinates of a polygon with corners like the places of a line."""
    ring = _continuous(corners)
    east, west = (_world(limit, ring[:, 0].mean()) for limit in (ring[:, 0].max(), ring[:, 0].min()))
    parts = []
    for world in range(west, east + 1):
        part = _clip(_clip(ring, 360.0 * world - 180.0, 1.0), 360.0 * world + 180.0, -1.0)
        closed = [_on_map(corner, world) for corner in (*part, *part[:1])]
        parts.append([closed])
    return ("Polygon", parts[0]) if len(parts) == 1 else ("MultiPolygon", parts)


def _continuous(places: Float[np.ndarray, "p 2"]) -> Float[np.ndarray, "p 2"]:
    """Return places whose longitudes go on beyond 180 degrees where they would jump."""
    return np.stack([np.unwrap(places[:, 0], period=360.0), places[:, 1]], axis=1)


def _world(longitude: float, towards: float) -> int:
    """Return how many times around the earth a longitude is; on the antimeridian, that of the longitudes ``towards`` it."""
    turns = (longitude + 180.0) / 360.0
    return int(turns) - 1 if turns == int(turns) and towards < longitude else int(np.floor(turns))


def _crossing(here: Float[np.ndarray, "2"], there: Float[np.ndarray, "2"], longitude: float) -> Float[np.ndarray, "2"]:
    """Return where the way between two places crosses a longitude."""
    share = (longitude - here[0]) / (there[0] - here[0])
    return np.array([longitude, here[1] + share * (there[1] - here[1])])


def _clip(ring: Float[np.ndarray, "m 2"], longitude: float, side: float) -> Float[np.ndarray, "k 2"]:
    """Return the part of a polygon that lies east (``side`` 1) or west (-1) of a longitude (Sutherland and Hodgman, 1974)."""
    kept: list[np.ndarray] = []
    for here, there in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        before, after = side * (here[0] - longitude), side * (there[0] - longitude)
        if before >= 0:
            kept.append(here)
        if before * after < 0:
            kept.append(_crossing(here, there, longitude))
    return np.array(kept).reshape(-1, 2)


def _on_map(place: Float[np.ndarray, "2"], world: int) -> list[float]:
    """Return a place with its longitude from -180 to 180."""
    return [float(place[0] - 360.0 * world), float(place[1])]

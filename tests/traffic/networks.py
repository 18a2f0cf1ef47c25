"""Small road networks, map extracts and evacuations with known answers."""

from itertools import product
from pathlib import Path

import numpy as np

from uavmec_jax.traffic.evacuation import Evacuation
from uavmec_jax.traffic.network import Road, RoadNetwork


def road(start, end, road_class, junctions, lanes=1, name=""):
    """Make a straight road between two junctions."""
    shape = np.array([junctions[start], junctions[end]], float)
    length = float(np.linalg.norm(shape[1] - shape[0]))
    return Road(f"{start}-{end}", name, road_class, lanes, 13.4, length, start, end, shape)


def both_ways(a, b, road_class, junctions, lanes=1):
    """Make the two directions of a road."""
    return [road(a, b, road_class, junctions, lanes), road(b, a, road_class, junctions, lanes)]


def network(roads, successors, junctions) -> RoadNetwork:
    """Make a network of roads; the junctions are points in metres."""
    points = {name: (float(x), float(y)) for name, (x, y) in junctions.items()}
    return RoadNetwork({road.id: road for road in roads}, successors, points, "0" * 64, Path("none"))


def village(exit_class="primary", cut=False) -> RoadNetwork:
    """Make a village street of 200 m, a road from its east end 500 m south to the exit, and a loop without a way out.

    Args:
        exit_class: class of the road to the exit.
        cut: whether there is no way from the street to that road.
    """
    junctions = {
        "west": (0, 0),
        "middle": (100, 0),
        "east": (200, 0),
        "south": (200, -500),
        "loop": (900, 0),
        "end": (900, 300),
    }
    roads = both_ways("west", "middle", "residential", junctions) + both_ways(
        "middle", "east", "residential", junctions
    )
    roads += both_ways("loop", "end", "residential", junctions)
    roads += both_ways("east", "south", exit_class, junctions, lanes=2)

    def joined(before, after):
        is_cut = cut and before.end == "east" and "south" in (before.start, after.end)
        return before.end == after.start and not is_cut

    successors = {before.id: tuple(after.id for after in roads if joined(before, after)) for before in roads}
    return network(roads, successors, junctions)


def evacuation(
    weight=(1.0, 0.5, 0.1), windows=((0.0, 0.2, 0.1), (1.0, 0.4, 0.1)), name="hamlet", span=300.0
) -> Evacuation:
    """Make an evacuation with invented densities: devices on a diagonal, two roads."""
    weight, windows = np.array(weight, np.float32), np.array(windows, np.float32)
    n = len(weight)
    meta = {
        "place": name,
        "description": "invented",
        "names": [f"site {k + 1}" for k in range(n)],
        "roads": ["a", "b"],
        "window_s": 600.0,
        "mean_s": [0.0, 600.0 * len(windows)],
        "mean_windows": [0, len(windows)],
        "radius_m": 100.0,
        "vehicles": 10,
        "seeds": 2,
        "loaded": [10, 10],
        "unfinished": [0, 1],
        "teleports": [0, 0],
        "cut_off": 1,
        "warnings": ["5% of the vehicles had not left at the end; simulate longer"],
        "sumo": "1.28.0",
        "network_sha256": "0" * 64,
        "command": "",
        "settings": {},
    }
    return Evacuation(
        meta=meta,
        position=np.linspace(0, span, n)[:, None].astype(np.float32) * np.array([1, 0.5], np.float32) + 1000,
        density=weight * 20,
        density_spread=weight,
        weight=weight,
        window_weight=windows,
        road_shape=np.array([[1000, 1000], [1100, 1000], [1000, 1000], [1000, 1200], [1050, 1250]], np.float32),
        road_corners=np.array([2, 3], np.int32),
        road_lanes=np.array([1, 2], np.int32),
        road_density=np.array([[0.0, 30.0], [4.0, 50.0], [2.0, 40.0]], np.float32)[: len(windows)],
    )


def osm_extract(rows=4, columns=4, spacing=0.0015) -> str:
    """Make an OpenStreetMap extract: a grid of streets from 9.70 E, 50.00 N on, and the two carriageways of a motorway."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<osm version="0.6" generator="by hand">']
    number = {}
    for row, column in product(range(rows), range(columns)):
        number[row, column] = 100 + row * columns + column
        lat, lon = 50.0 + row * spacing, 9.7 + column * spacing
        lines.append(f'<node id="{number[row, column]}" lat="{lat:.6f}" lon="{lon:.6f}"/>')
    east = 9.7 + (columns - 1) * spacing
    highway = {900: (49.99, east + 0.004), 901: (50.0, east + 0.004), 902: (50.02, east + 0.004)}
    highway |= {910: (50.02, east + 0.0045), 911: (50.0, east + 0.0045), 912: (49.99, east + 0.0045)}
    lines += [f'<node id="{k}" lat="{lat:.6f}" lon="{lon:.6f}"/>' for k, (lat, lon) in highway.items()]
    ways = [([number[row, column] for column in range(columns)], "residential", "no") for row in range(rows)]
    ways += [([number[row, column] for row in range(rows)], "residential", "no") for column in range(columns)]
    ways += [([900, 901, 902], "motorway", "yes"), ([910, 911, 912], "motorway", "yes")]
    ways += [
        ([number[0, columns - 1], 901], "motorway_link", "yes"),
        ([911, number[0, columns - 1]], "motorway_link", "yes"),
    ]
    for k, (nodes, road_class, oneway) in enumerate(ways):
        lines.append(f'<way id="{500 + k}">' + "".join(f'<nd ref="{node}"/>' for node in nodes))
        lines.append(f'<tag k="highway" v="{road_class}"/><tag k="oneway" v="{oneway}"/></way>')
    return "\n".join([*lines, "</osm>"])

"""Positions of the devices, and the traffic density near them."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from tests.traffic.networks import both_ways, network, road, village
from uavmec_jax.errors import TrafficError
from uavmec_jax.traffic.demand import find_routes
from uavmec_jax.traffic.devices import _junction_names, farthest_points, place_devices
from uavmec_jax.traffic.place import Demand, make_place
from uavmec_jax.traffic.weights import density_near, divide_by_maximum, length_within

LINE = np.array([[-1000.0, 0.0], [1000.0, 0.0]])


def test_length_of_a_straight_road_in_a_circle():
    centres = np.array([[0.0, 0.0], [0.0, 60.0], [0.0, 100.0], [0.0, 150.0], [1000.0, 0.0], [2000.0, 0.0]])
    assert_allclose(length_within(LINE, centres, 100.0), [200, 160, 0, 0, 100, 0], atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(
    corners=st.lists(st.tuples(st.floats(-300, 300), st.floats(-300, 300)), min_size=2, max_size=5),
    x=st.floats(-200, 200),
    y=st.floats(-200, 200),
)
def test_length_in_a_circle_against_small_steps(corners, x, y):
    shape = np.array(corners)
    pieces = [np.linspace(a, b, 2001) for a, b in pairwise(shape)]
    brute = sum(
        np.linalg.norm(piece[1] - piece[0])
        * (np.linalg.norm((piece[1:] + piece[:-1]) / 2 - [x, y], axis=1) <= 120).sum()
        for piece in pieces
    )
    length = length_within(shape, np.array([[x, y]]), 120.0)[0]
    assert length == pytest.approx(brute, abs=1.0 * len(pieces) + 1e-3)
    assert length >= 0


def test_density_is_a_mean_over_lanes_and_metres():
    # 200 m of a road with 3 lanes at 10 vehicles/km/lane, 100 m of one with 1 lane at 50: (600 * 10 + 100 * 50) / 700.
    shapes = [LINE, np.array([[0.0, 0.0], [0.0, 1000.0]])]
    near = density_near(
        np.array([[0.0, 0.0], [5000.0, 0.0]]), shapes, np.array([3, 1]), np.array([[10.0, 50.0]]), 100.0
    )
    assert_allclose(near, [[11_000 / 700, 0.0]])


def test_weights_are_between_0_and_1():
    assert_allclose(divide_by_maximum(np.array([2.0, 8.0, 0.0])), [0.25, 1, 0])
    assert_allclose(divide_by_maximum(np.zeros(3)), 0)


def test_farthest_points_spread():
    position = np.array([[0.0, 0], [1, 0], [2, 0], [10, 0], [11, 0]])
    assert farthest_points(position, np.arange(5), 2, []) == [4, 0]
    assert farthest_points(position, np.arange(4), 3, [4]) == [4, 0, 2, 1]
    assert farthest_points(position, np.array([1]), 3, [0]) == [0, 1]


def grid():
    """Make 5 x 5 junctions 100 m apart, and a highway that continues the southern street."""
    junctions = {f"{x}{y}": (100.0 * x, 100.0 * y) for x in range(5) for y in range(5)} | {"out": (900.0, 0.0)}
    pairs = [(f"{x}{y}", f"{x + 1}{y}") for x in range(4) for y in range(5)]
    pairs += [(f"{x}{y}", f"{x}{y + 1}") for x in range(5) for y in range(4)]
    roads = [road for a, b in pairs for road in both_ways(a, b, "residential", junctions)]
    roads.append(road("40", "out", "primary", junctions))
    successors = {before.id: tuple(after.id for after in roads if after.start == before.end) for before in roads}
    return network(roads, successors, junctions)


def place_in_grid(**devices):
    """Place devices in the grid, with the traffic on its southern street."""
    place, roads = make_place({"name": "g", "network": {"net": "x"}, "devices": devices}, "g"), grid()
    on_southern_street = [road.start.endswith("0") and road.end.endswith("0") for road in roads.roads.values()]
    return place_devices(place, roads, find_routes(roads, Demand(), "g"), np.where(on_southern_street, 40.0, 1.0))


def test_a_stated_share_stands_on_the_corridors():
    names, position = place_in_grid(count=6, corridor_share=0.5, span_m=900.0, radius_m=60.0)
    assert len(set(names)) == 6
    assert sum(name.endswith("0") for name in names) == 3
    assert position.shape == (6, 2)
    names, _ = place_in_grid(count=6, corridor_share=0.0, span_m=900.0, radius_m=60.0)
    assert not any(name.endswith("0") for name in names)


def test_devices_are_named_after_their_streets():
    junctions = {"a": (0, 0), "b": (100, 0), "c": (200, 0), "d": (200, 100), "e": (300, 0)}
    pairs = {"ab": "High Street", "bc": "High Street", "cd": "Mill Lane", "ce": ""}
    roads = [road(*pair, "residential", junctions, name=name) for pair, name in pairs.items()]
    named = network(roads, {}, junctions)
    assert _junction_names(["a", "c", "d", "e"], named) == [
        "High Street",
        "High Street and Mill Lane",
        "Mill Lane",
        "e",
    ]
    assert _junction_names(["a", "b"], named) == ["High Street (a)", "High Street (b)"]


def test_names_of_devices_can_be_printed_differ_and_are_as_long_as_names_may_be():
    junctions = {"a": (0, 0), "b": (100, 0), "c" * 200: (200, 0), "d" * 200: (300, 0), "e": (400, 0)}
    streets = {("a", "b"): "Ring\u00a0Road\u200b\x1b", ("c" * 200, "d" * 200): "", ("d" * 200, "e"): "x" * 300}
    roads = [road(*pair, "residential", junctions, name=name) for pair, name in streets.items()]
    names = _junction_names(list(junctions), network(roads, {}, junctions))
    assert names[:2] == ["Ring Road (a)", "Ring Road (b)"]
    assert len(set(names)) == 5
    assert all(name.isprintable() and len(name) <= 80 for name in names)


def test_more_devices_than_junctions():
    with pytest.raises(
        TrafficError, match=r"g: 30 devices, but 25 junctions in the 900 m around where people live \(26 in"
    ):
        place_in_grid(count=30, span_m=900.0)


def test_sites_of_a_file():
    sites = [{"name": "a", "junction": "east"}, {"name": "b", "x_m": 5.0, "y_m": 6.0}]
    place = make_place({"name": "v", "network": {"net": "x"}, "device": sites}, "v")
    roads = village()
    routes, density = find_routes(roads, Demand(), "v"), np.zeros(len(roads.roads))
    names, position = place_devices(place, roads, routes, density)
    assert names == ["a", "b"]
    assert_allclose(position, [[200, 0], [5, 6]])
    sites[0]["junction"] = "esat"
    place = make_place({"name": "v", "network": {"net": "x"}, "device": sites}, "v")
    with pytest.raises(
        TrafficError, match=r"v: device 1 \(a\): junction is 'esat', which does not exist; did you mean 'west'"
    ):
        place_devices(place, roads, routes, density)

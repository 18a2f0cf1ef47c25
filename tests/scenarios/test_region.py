"""Regions that are polygons: their box, what lies inside, and corners that make no polygon."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from tests.scenarios.test_fleet_files import a_device, make, read_back
from uavmec_jax.errors import ScenarioError
from uavmec_jax.scenarios.named_scenario import make_named_scenario
from uavmec_jax.scenarios.region import inside_polygon, metres_per_degree

L_SHAPE = [[0.0, 0.0], [600.0, 0.0], [600.0, 100.0], [200.0, 100.0], [200.0, 500.0], [0.0, 500.0]]


def within(x, y, region=L_SHAPE, **tables):
    return make(device=[a_device("a", x, y)], region=region, **tables)


def test_the_region_is_the_box_around_the_polygon():
    scenario = within(100, 400)
    assert scenario.params.region_m == (600.0, 500.0)
    assert read_back(scenario).file == scenario.file
    assert within(100, 400, [*L_SHAPE, L_SHAPE[0]]).params.region_m == (600.0, 500.0)  # closed, as in GeoJSON


@pytest.mark.parametrize("point", [(0, 0), (600, 100), (200, 100), (300, 0), (200, 300), (100, 500), (200 + 1e-4, 300)])
def test_the_edge_is_inside(point):
    within(*point)


@pytest.mark.parametrize(
    ("tables", "subject"),
    [
        ({"device": [a_device("a", 201, 300)]}, "device 1 (a): lies at 201, 300 m"),
        ({"device": [a_device("a", 1, 1), a_device("b", 700, 50)]}, "device 2 (b): lies at 700, 50 m"),
        ({"depot": [{"x_m": 400.0, "y_m": 300.0}]}, "depot 1 (no name): lies at 400, 300 m"),
        ({"uav": [{}, {"name": "u", "x_m": 599.0, "y_m": 499.0}]}, "uav 2 (u): lies at 599, 499 m"),
    ],
)
def test_outside_the_polygon_is_refused(tables, subject):
    with pytest.raises(ScenarioError) as error:
        make(**{"device": [a_device("a", 1, 1)], "region": L_SHAPE} | tables)
    assert str(error.value) == f"s.toml: {subject}, outside the polygon of region; move it or give a larger region"


def test_the_default_start_may_lie_outside():
    triangle = [[100.0, 0.0], [200.0, 300.0], [0.0, 300.0]]
    assert within(100, 200, triangle, uav=[{}]).layout.fleet.start_m.tolist() == [[0, 0]]
    assert within(100, 200, triangle).state.uav_position.tolist() == [[0, 0]]


def test_degrees_begin_at_the_south_western_corner():
    device = {"name": "a", "lon": 9.001, "lat": 50.001, "type": "Firefly", "task": "DNN", "capacity_j": 5e4}
    region = [[9.0, 50.0], [9.004, 50.001], [9.003, 50.003]]
    scenario = make_named_scenario({"device": [device], "region": region}, "x")
    assert scenario.origin == (9.0, 50.0)
    assert_allclose(scenario.params.region_m, np.array([0.004, 0.003]) * metres_per_degree(50.0), rtol=1e-9)
    assert_allclose(scenario.geographic(np.asarray(scenario.layout.position)), [[9.001, 50.001]], atol=1e-6)
    further = make_named_scenario({"device": [device], "region": region, "origin": [8.999, 49.999]}, "x")
    assert_allclose(further.params.region_m, np.array([0.005, 0.004]) * metres_per_degree(49.999), rtol=1e-6)
    with pytest.raises(ScenarioError, match="region: corner 1 lies at -71, 0 m; give corners north and east of the or"):
        make_named_scenario({"device": [device], "region": region, "origin": [9.001, 50.0]}, "x")


BAD = {
    "two corners": (L_SHAPE[:2], "region has 2 different corners; give 3 to 1000"),
    "closed line": ([*L_SHAPE[:2], L_SHAPE[0]], "region has 2 different corners"),
    "empty": ([], "region has 0 different corners"),
    "line": ([[0.0, 0.0], [300.0, 300.0], [600.0, 600.0]], "region has no area; give the corners in order, around it"),
    "bow tie": (
        [[0.0, 0.0], [600.0, 700.0], [600.0, 0.0], [0.0, 500.0]],
        "region: the sides from corners 1 and 3 meet; give the corners in order, around it",
    ),
    "corner twice": ([[0.0, 0.0], [600.0, 0.0], [600.0, 0.0], [0.0, 500.0]], "the sides from corners 1 and 2 meet"),
    "spike": ([[0.0, 0.0], [600.0, 0.0], [300.0, 0.0], [0.0, 500.0]], "the sides from corners 1 and 2 meet"),
    "touches": (
        [[0.0, 0.0], [600.0, 0.0], [600.0, 500.0], [300.0, 0.0], [0.0, 500.0]],
        "the sides from corners 1 and 3 meet",
    ),
    "negative": ([[-5.0, 0.0], [600.0, 0.0], [600.0, 500.0]], "region: corner 1 lies at -5, 0 m; give corners north"),
    "not finite": (
        [[math.nan, 0.0], [600.0, 0.0], [600.0, 500.0]],
        "region: item 1: item 1 is nan; it should be a finite number",
    ),
    "one number": ([[0.0], [600.0, 0.0], [600.0, 500.0]], "region: item 1: item 2 is missing"),
}


@pytest.mark.parametrize(("region", "message"), BAD.values(), ids=BAD)
def test_bad_polygon_is_refused_in_one_line(region, message):
    with pytest.raises(ScenarioError) as error:
        within(1, 1, region)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_two_regions_are_refused():
    with pytest.raises(ScenarioError, match=r"region and params\.region_m are both given; leave one of them out"):
        within(1, 1, params={"region_m": [800.0, 800.0]})


def test_degrees_out_of_range_are_refused():
    device = {"name": "a", "lon": 9.0, "lat": 50.0, "type": "Firefly", "task": "DNN", "capacity_j": 5e4}
    with pytest.raises(
        ScenarioError, match=r"corner 3 is \[9.5, 90.0\]; give \[longitude, latitude\] from -180 to 360 and from -89"
    ):
        make_named_scenario({"device": [device], "region": [[9.0, 50.0], [10.0, 50.0], [9.5, 90.0]]}, "x")


@settings(max_examples=60, deadline=None)
@given(
    radii=st.lists(st.floats(20, 300), min_size=3, max_size=9),
    point=st.tuples(st.floats(0, 800), st.floats(0, 800)),
)
def test_a_star_holds_the_points_that_its_centre_sees(radii, point):
    """Around (400, 400) the sides of a polygon with corners in the order of their angles are easy to compare with."""
    angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
    corners = 400 + np.array(radii)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    off = np.array(point) - 400
    sector = int(np.arctan2(off[1], off[0]) % (2 * np.pi) / (2 * np.pi) * len(radii)) % len(radii)
    a, b = corners[sector] - 400, corners[(sector + 1) % len(radii)] - 400
    beyond = (b[0] - a[0]) * (off[1] - a[1]) - (b[1] - a[1]) * (off[0] - a[0])
    assume(abs(beyond) > 1e-3 * np.hypot(*(b - a)))
    assert bool(inside_polygon(np.array([point]), corners, 0.0)[0]) == (beyond > 0)
    make(device=[a_device("a", 400, 400)], region=corners.tolist())

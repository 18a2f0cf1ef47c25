"""Lines and polygons that cross the antimeridian are cut there; all others stay as they are, to the bit."""

import numpy as np
import pytest

from uavmec_jax.reporting.antimeridian import line_geometry, polygon_geometry


def test_a_line_elsewhere_stays_as_it_is():
    places = np.random.default_rng(0).uniform([9.9, 53.5], [10.1, 53.6], (7, 2))
    assert line_geometry(places) == ("LineString", places.tolist())
    assert polygon_geometry(places) == ("Polygon", [[*places.tolist(), places[0].tolist()]])


def test_a_line_is_cut_where_it_crosses():
    kind, parts = line_geometry(np.array([[179.0, 0.0], [-179.0, 2.0], [-178.0, 2.0], [179.5, 4.5]]))
    assert kind == "MultiLineString"
    assert parts == [
        [[179.0, 0.0], [180.0, 1.0]],
        [[-180.0, 1.0], [-179.0, 2.0], [-178.0, 2.0], [-180.0, 4.0]],
        [[180.0, 4.0], [179.5, 4.5]],
    ]


@pytest.mark.parametrize("there", [180.0, -180.0])
def test_a_line_that_ends_on_the_antimeridian_is_not_cut(there):
    assert line_geometry(np.array([[179.0, 0.0], [there, 1.0], [179.0, 2.0]])) == (
        "LineString",
        [[179.0, 0.0], [180.0, 1.0], [179.0, 2.0]],
    )


def test_a_line_of_one_place():
    assert line_geometry(np.array([[180.0, 1.0], [180.0, 1.0]]))[0] == "LineString"


def test_a_polygon_is_cut_in_two():
    kind, parts = polygon_geometry(np.array([[179.0, 0.0], [-179.0, 0.0], [-179.0, 1.0], [179.0, 1.0]]))
    assert kind == "MultiPolygon"
    assert parts == [
        [[[179.0, 0.0], [180.0, 0.0], [180.0, 1.0], [179.0, 1.0], [179.0, 0.0]]],
        [[[-180.0, 0.0], [-179.0, 0.0], [-179.0, 1.0], [-180.0, 1.0], [-180.0, 0.0]]],
    ]


def test_a_polygon_that_ends_on_the_antimeridian_is_not_cut():
    corners = [[179.0, 0.0], [180.0, 0.0], [180.0, 1.0]]
    assert polygon_geometry(np.array(corners)) == ("Polygon", [[*corners, corners[0]]])

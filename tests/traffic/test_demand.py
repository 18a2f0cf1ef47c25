"""Travel demand: origins, exits, departure times and trips."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from tests.traffic.networks import village
from uavmec_jax.errors import TrafficError
from uavmec_jax.traffic.demand import departures, find_routes, write_trips
from uavmec_jax.traffic.place import Demand


def test_origins_are_residential_roads_by_length_and_exits_are_highway_ends():
    routes = find_routes(village(), Demand(), "v")
    assert [road.id for road in routes.origins] == ["west-middle", "middle-west", "middle-east", "east-middle"]
    assert_allclose(routes.origin_share, 0.25)
    assert [road.id for road in routes.exits] == ["east-south"]
    assert_allclose(routes.exit_share, 1.0)
    assert routes.cut_off == 2  # the loop
    assert [road.id for road in routes.entries] == ["south-east"]
    assert routes.through_share.sum() == 0  # there is only one end


def test_given_origins_and_exits():
    routes = find_routes(village(), Demand(origins=("middle-east",), exits={"south": 3.0, "west": 1.0}), "v")
    assert [road.id for road in routes.exits] == ["east-south", "middle-west"]
    assert_allclose(routes.exit_share, [[0.75, 0.25]])


@pytest.mark.parametrize(
    ("network", "demand", "line"),
    [
        (
            village("secondary"),
            Demand(),
            "v: has no highway exit (no motorway, motorway_link, trunk, trunk_link, primary",
        ),
        (village(cut=True), Demand(), "v: none of its 6 residential roads has a way to any exit; give demand.exits"),
        (
            village(),
            Demand(origins=("loop-end",)),
            "v: demand.origins has 'loop-end', from which no way leads to any exit",
        ),
        (
            village(),
            Demand(origins=("wset",)),
            "v: demand.origins has 'wset', which is not a road; did you mean 'west-m",
        ),
        (
            village(),
            Demand(exits={"suoth": 1.0}),
            "v: demand.exits has 'suoth', which is neither a road nor a junction; did",
        ),
    ],
    ids=["no exit", "cut off", "origin cut off", "no such road", "no such exit"],
)
def test_bad_demand_is_one_line(network, demand, line):
    with pytest.raises(TrafficError) as caught:
        find_routes(network, demand, "v")
    assert str(caught.value).startswith(line)


def test_loading_is_rayleighs():
    times = departures(Demand(vehicles=20_000, loading_sigma_s=1200.0), 1e9, np.random.default_rng(0))
    assert stats.kstest(times, lambda t: 1 - np.exp(-(t**2) / (2 * 1200.0**2))).pvalue > 0.01
    assert (np.diff(times) >= 0).all()
    early = departures(Demand(vehicles=20_000, loading_sigma_s=1200.0), 1200.0, np.random.default_rng(0))
    assert_allclose(len(early) / 20_000, 1 - np.exp(-0.5), atol=0.01)
    assert early.max() < 1200


def test_trips_are_sorted_repeatable_and_go_to_the_exits(tmp_path):
    demand = Demand(vehicles=400, exits={"south": 3.0, "west": 1.0})
    routes = find_routes(village(), demand, "v")
    counts = [write_trips(tmp_path / f"{k}.xml", routes, demand, 7200.0, seed) for k, seed in enumerate((1, 1, 2))]
    texts = [(tmp_path / f"{k}.xml").read_text() for k in range(3)]
    assert texts[0] == texts[1] != texts[2]
    trips = ElementTree.fromstring(texts[0]).findall("trip")
    assert len(trips) == counts[0] == 400
    depart = np.array([float(trip.get("depart")) for trip in trips])
    assert (np.diff(depart) >= 0).all()
    assert depart.min() >= demand.warm_up_s
    south = np.mean([trip.get("to") == "east-south" for trip in trips])
    assert abs(south - 0.75) < 0.07

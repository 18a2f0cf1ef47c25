"""Scenario files with UAVs, depots and priorities: read, written back, and refused where they are wrong."""

import re
import time
from dataclasses import replace

import chex
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from tests.scenarios.test_scenario_files import DEVICE, EXAMPLES, write
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.fleet import DepotKind, make_depots, make_fleet
from uavmec_jax.env.layout import fleet_of, sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.errors import ScenarioError
from uavmec_jax.files.parsing import parse_toml
from uavmec_jax.scenarios.load import load_scenario
from uavmec_jax.scenarios.named_scenario import make_named_scenario, name_scenario
from uavmec_jax.scenarios.scenario_files import load_scenario_file, scenario_text
from uavmec_jax.scenarios.schema import DepotTable, Device, Uav

FLEET = EXAMPLES / "harbour_fleet.toml"


def a_device(name, x, y, **more):
    listed = {"type": "Firefly", "task": "DNN", "capacity_j": 5e4}
    return {"name": name, "x_m": float(x), "y_m": float(y)} | listed | more


def make(**tables):
    return make_named_scenario({"device": [a_device("a", 1, 2), a_device("b", 300, 400)]} | tables, "s.toml")


def read_back(scenario):
    return make_named_scenario(parse_toml(scenario_text(scenario), "again", ScenarioError), "again")


def test_the_example_has_two_uavs_and_a_depot():
    harbour = load_scenario_file(FLEET)
    layout, fleet, depots = harbour.layout, harbour.layout.fleet, harbour.layout.depots
    assert harbour.uav_names == ["gull", "tern"]
    assert harbour.depot_names == ["pilot station"]
    assert harbour.place_names == [*harbour.device_names, "pilot station"]
    assert (layout.n_uavs, layout.n_depots, layout.n_places) == (2, 1, 6)
    assert fleet.speed_m_s.tolist() == [5, 8]
    assert fleet.battery_j.tolist() == [1_600_000, 900_000]
    assert fleet.hovering_power_w.tolist() == [80, 80]
    assert_array_equal(fleet.start_m, [depots.position[0], layout.position[0]])
    assert (int(depots.kind[0]), float(depots.pads[0]), float(depots.packs[0])) == (DepotKind.SWAP, 1, 4)
    assert layout.priority.tolist() == [3, 1, 1, 1, 1]
    assert (harbour.params.end, harbour.params.horizon_s) == ("horizon", 21_600)
    assert_allclose(harbour.geographic(np.asarray(layout.places()))[-1], [9.9878, 53.544], atol=1e-6)
    chex.assert_trees_all_equal(harbour.state, initial_state(harbour.params, layout))


def test_the_example_is_read_back():
    harbour = load_scenario_file(FLEET)
    again = read_back(harbour)
    assert again.file == harbour.file
    assert again.params == harbour.params
    chex.assert_trees_all_equal(again.layout, harbour.layout)


def test_the_docs_show_the_format():
    text = (EXAMPLES.parent / "planning.md").read_text()
    devices, fleet = (
        parse_toml(block, "docs", ScenarioError) for block in re.findall(r"```toml\n(.*?)```", text, re.DOTALL)[:2]
    )
    make_named_scenario(devices, "docs")
    scenario = make_named_scenario({"device": devices["device"]} | fleet, "docs")
    given = {table: set(fleet[table][0]) for table in ("uav", "depot")}
    assert set(Uav.model_fields) - given["uav"] == {"x_m", "y_m", "lon", "lat"}
    assert set(DepotTable.model_fields) - given["depot"] == {"x_m", "y_m", "power_w"}
    assert set(Device.model_fields) - set(devices["device"][0]) == {"x_m", "y_m"}
    assert scenario.layout.n_places == 2


def test_without_tables_there_is_the_paper():
    scenario = make()
    assert (scenario.layout.fleet, scenario.layout.depots, scenario.layout.priority) == (None, None, None)
    assert (scenario.uav_names, scenario.depot_names, scenario.place_names) == (["uav 1"], [], ["a", "b"])
    assert not {"uav", "depot", "priority", "region"} & set(scenario_text(scenario).replace("=", " ").split())


def test_one_empty_table_is_the_uav_of_the_parameters():
    scenario = make(uav=[{}], params={"uav_battery_j": 1e6})
    chex.assert_trees_all_equal(scenario.layout.fleet, fleet_of(scenario.params, make().layout))
    chex.assert_trees_all_equal(replace(scenario.layout, fleet=None), make().layout)


def test_missing_starts_are_depots_in_turn_and_missing_numbers_those_of_the_parameters():
    depots = [{"x_m": 5.0, "y_m": 6.0}, {"name": "quay", "x_m": 7.0, "y_m": 8.0, "kind": "charge", "power_w": 50.0}]
    uavs = [{}, {"name": "b", "x_m": 9.0, "y_m": 9.0}, {"battery_j": 5e5}, {"at": "b"}, {"at": "quay"}]
    scenario = make(uav=uavs, depot=depots, params={"uav_speed_m_s": 4.0, "uav_signal_range_m": 50.0})
    fleet, made = scenario.layout.fleet, scenario.layout.depots
    assert fleet.start_m.tolist() == [[5, 6], [9, 9], [5, 6], [300, 400], [7, 8]]
    assert fleet.speed_m_s.tolist() == [4] * 5
    assert fleet.signal_range_m.tolist() == [50] * 5
    assert fleet.battery_j.tolist() == [1.6e6, 1.6e6, 5e5, 1.6e6, 1.6e6]
    assert scenario.uav_names == ["uav 1", "b", "uav 3", "uav 4", "uav 5"]
    assert scenario.depot_names == ["depot 1", "quay"]
    assert made.kind.tolist() == [DepotKind.SWAP, DepotKind.CHARGE]
    assert made.pads.tolist() == made.packs.tolist() == [np.inf] * 2
    assert made.power_w.tolist() == [667, 50]


def test_the_only_uav_starts_at_the_first_depot():
    scenario = make(depot=[{"x_m": 5.0, "y_m": 6.0, "pads": 2, "packs": np.inf}])
    assert scenario.layout.fleet is None
    assert scenario.state.uav_position.tolist() == [[5, 6]]
    assert scenario.state.packs.tolist() == [np.inf]


def test_the_area_that_degrees_span_has_depots_and_starts_too():
    degrees = {"type": "Firefly", "task": "DNN", "capacity_j": 5e4, "lat": 50.0}
    tables = {
        "device": [{"name": "a", "lon": 9.0} | degrees, {"name": "b", "lon": 9.001} | degrees],
        "depot": [{"lon": 8.999, "lat": 50.001}],
    }
    scenario = make_named_scenario(tables | {"uav": [{"lon": 9.002, "lat": 50.002}]}, "x")
    assert scenario.origin == (8.999, 50.0)
    assert_allclose(scenario.params.region_m, scenario.layout.fleet.start_m[0], rtol=1e-6)
    assert_allclose(scenario.geographic(np.asarray(scenario.layout.depots.position)), [[8.999, 50.001]], atol=1e-6)


def test_a_csv_has_priorities_and_nothing_else(tmp_path):
    text = "name,x_m,y_m,type,task,capacity_j,priority\na,1,2,Firefly,DNN,50000,2.5\nb,3,4,Firefly,DNN,50000,\n"
    scenario = load_scenario_file(write(tmp_path, text, "s.csv"))
    assert scenario.layout.priority.tolist() == [2.5, 1]
    again = load_scenario_file(write(tmp_path, scenario_text(scenario, ".csv"), "s.csv"))
    assert again.file == scenario.file
    for tables, words in [
        ({"depot": [{"x_m": 0.0, "y_m": 0.0}], "uav": [{}]}, "a CSV has no place for depots and UAVs; write TOML"),
        ({"region": [[0.0, 0.0], [800.0, 0.0], [0.0, 900.0]]}, "a CSV has no place for region; write TOML"),
    ]:
        with pytest.raises(ScenarioError, match=words):
            scenario_text(make(**tables), ".csv")


def test_a_layout_with_a_fleet_is_named_and_read_back():
    params = Params(region_m=(500.0, 400.0), uav_battery_j=1e6)
    depots = make_depots([[3.1, 4.7], [100.0, 0.3]], ["charge", "swap"], 2, np.array([np.inf, 7]), np.array([80, 667]))
    fleet = make_fleet(
        params, 3, depots, speed_m_s=np.array([5, 6.1, 7]), start_m=np.array([[3.1, 4.7], [0, 0], [100, 0.3]])
    )
    layout = sample_layout(jax.random.key(3), params, 8, 8)
    layout = replace(layout, fleet=fleet, depots=depots, priority=np.linspace(0, 2, 12, dtype=np.float32))
    scenario = name_scenario(layout, params, "random")
    for named in (scenario, read_back(scenario)):
        chex.assert_trees_all_equal(named.layout, layout)
    assert scenario.file.uav[0].at == "depot 1"
    padded = replace(fleet, present=np.array([True, False, True]))
    assert name_scenario(replace(layout, fleet=padded), params, "random").layout.fleet.speed_m_s.tolist() == [5, 7]


numbers = st.floats(0.5, 1e3)
devices = st.fixed_dictionaries({}, optional={"priority": st.floats(0.1, 9), "comms": st.booleans()})
depots = st.one_of(
    st.fixed_dictionaries({"kind": st.just("swap")}, optional={"packs": st.sampled_from([0, 3, 2.0, np.inf])}),
    st.fixed_dictionaries({"kind": st.just("charge")}, optional={"power_w": numbers, "pads": st.integers(1, 5)}),
)
uavs = st.one_of(
    st.fixed_dictionaries({}, optional={"at": st.sampled_from(["device 1", "device 2"]), "speed_m_s": numbers}),
    st.fixed_dictionaries(
        {"x_m": st.floats(0, 800), "y_m": st.floats(0, 800)},
        optional={"signal_range_m": numbers, "flying_power_w": st.just(0.0) | st.floats(1e-3, 200)},
    ),
)
positions = st.tuples(st.floats(0, 800), st.floats(0, 800))


@st.composite
def scenarios(draw):
    """A valid scenario as plain data."""

    def tables(name, strategy, least, most, placed=True):
        chosen = draw(st.lists(strategy, min_size=least, max_size=most))
        points = [draw(positions) if placed else () for _ in chosen]
        names = [{"name": f"{name} {number}"} if draw(st.booleans()) else {} for number in range(1, len(chosen) + 1)]
        where = [dict(zip(("x_m", "y_m"), point, strict=False)) for point in points]
        return [table | place | label for table, place, label in zip(chosen, where, names, strict=True)]

    places = [
        a_device(f"device {number}", table.pop("x_m"), table.pop("y_m")) | table
        for number, table in enumerate(tables("device", devices, 2, 4), 1)
    ]
    params = draw(st.sampled_from([{}, {"end": "horizon", "horizon_s": 900.0}, {"end_share": 0.5}]))
    return {"device": places, "depot": tables("depot", depots, 0, 3), "uav": tables("uav", uavs, 0, 4, False)} | (
        {"params": params} if params else {}
    )


@settings(max_examples=60, deadline=None)
@given(scenarios())
def test_any_scenario_is_read_back(data):
    scenario = make_named_scenario(data, "x")
    again = read_back(scenario)
    assert again.file == scenario.file
    assert again.params == scenario.params
    chex.assert_trees_all_equal(again.layout, scenario.layout)
    chex.assert_trees_all_equal(again.state, scenario.state)


UAV = "\n[[uav]]\n"
DEPOT = '\n[[depot]]\nname = "port"\nx_m = 9.0\ny_m = 9.0\n'
FAR = DEVICE.replace('"a"', '"b"').replace("x_m = 1.0", "x_m = 700.0")

BAD = {
    "no battery": (UAV + 'name = "u"\nbattery_j = 0', "uav 1 (u): battery_j is 0; it should be greater than 0"),
    "negative power": (UAV + "flying_power_w = -1.0", "uav 1 (no name): flying_power_w is -1.0; it should be greater"),
    "infinite speed": (UAV + "speed_m_s = inf", "uav 1 (no name): speed_m_s is inf; it should be a finite number"),
    "unknown field": (UAV + "speed = 3.0", "uav 1 (no name): speed is not a setting; did you mean 'speed_m_s'?"),
    "too many UAVs": (UAV * 101, "holds 101 [[uav]] tables; give at most 100"),
    "place": (UAV + 'name = "u"\nat = "nowhere"', "uav 1 (u): at is 'nowhere'; the places are a"),
    "two starts": (
        UAV + 'at = "a"\nx_m = 3.0\ny_m = 4.0',
        "uav 1 (no name): at and coordinates are both given; leave one",
    ),
    "half a start": (
        UAV + "x_m = 3.0",
        "uav 1 (no name): position is unclear; give at, or x_m and y_m, or lon and lat",
    ),
    "other coordinates": (UAV + "lon = 3.0\nlat = 4.0", "uav 1 (no name): position is unclear"),
    "start outside": (
        UAV + "x_m = 3.0\ny_m = -4.0",
        "uav 1 (no name): lies at 3, -4 m, outside the region of 800 x 800",
    ),
    "same UAVs": ((UAV + 'name = "u"') * 2, "uav 2: name is 'u', which another uav has; names must differ"),
    "default name": (UAV + 'name = "uav 2"' + UAV, "uav 2: name is 'uav 2', which another uav has"),
    "depot outside": (
        DEPOT.replace("x_m = 9.0", "x_m = 900.0"),
        "depot 1 (port): lies at 900, 9 m, outside the region",
    ),
    "no depot's place": (
        DEPOT.replace("x_m = 9.0", ""),
        "depot 1 (port): position is unclear; give x_m and y_m, or lon",
    ),
    "no pads": (DEPOT + "pads = 0", "depot 1 (port): pads is 0; it should be greater than or equal to 1"),
    "half a pad": (DEPOT + "pads = 1.5", "depot 1 (port): pads is 1.5; it should be a whole number or inf"),
    "no number": (DEPOT + "pads = nan", "depot 1 (port): pads is nan; it should be"),
    "negative packs": (DEPOT + "packs = -1", "depot 1 (port): packs is -1; it should be greater than or equal to 0"),
    "kind": (DEPOT + 'kind = "swop"', "depot 1 (port): kind is 'swop'; it should be 'swap' or 'charge'"),
    "packs of a charger": (
        DEPOT + 'kind = "charge"\npacks = 3',
        'depot 1 (port): packs is 3, but it charges batteries; leave packs out, or give kind = "swap"',
    ),
    "power of a swapper": (
        DEPOT + "power_w = 300.0",
        'depot 1 (port): power_w is 300, but it swaps batteries; leave power_w out, or give kind = "charge"',
    ),
    "same places": (DEPOT.replace("port", "a"), "depot 1: name is 'a', which a device has; names must differ"),
    "same depots": (DEPOT * 2, "depot 2: name is 'port', which another depot has"),
    "negative priority": (
        DEVICE.replace('"a"', '"b"') + "priority = -1.0",
        "device 1 (b): priority is -1.0; it should",
    ),
    "hop": (
        FAR + UAV + "battery_j = 10.0" + UAV + 'name = "u"\nbattery_j = 12_000.0',
        "the hop from b to a is 699 m long; u, which flies furthest on a full battery, can fly at most 400 m; give it more",
    ),
    "hop to a depot": (
        "[params]\nuav_battery_j = 12_000.0" + DEPOT.replace("x_m = 9.0", "x_m = 700.0") + DEVICE,
        "the hop from the start to a, 699 m, takes 21 kJ; the UAV's battery holds 12 kJ (params.uav_battery_j)",
    ),
    "start": (
        UAV + UAV + 'name = "u"\nx_m = 700.0\ny_m = 1.0\nbattery_j = 12_000.0',
        "uav 2 (u): reaches no place from its start: it flies 400 m on a full battery, and a, the nearest, is 699 m away",
    ),
    "end": ('[params]\nend = "horzon"', "params.end is 'horzon'; it should be 'first_failure' or 'horizon'"),
    "share": ("[params]\nend_share = 0.0", "params.end_share is 0.0; it should be greater than 0"),
}


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD)
def test_bad_inventory_is_refused_in_one_line(tmp_path, text, message):
    with pytest.raises(ScenarioError) as error:
        load_scenario_file(write(tmp_path, text + ("" if DEVICE in text else DEVICE)))
    assert message in str(error.value)
    assert str(error.value).startswith(str(tmp_path / "scenario.toml"))
    assert "\n" not in str(error.value)


def test_no_priority_at_all_is_refused():
    with pytest.raises(ScenarioError, match="priority is 0 for all devices; give at least one of them more"):
        make(device=[a_device("a", 1, 2, priority=0.0), a_device("b", 3, 4, priority=0.0)])
    assert make(device=[a_device("a", 1, 2, priority=0.0), a_device("b", 3, 4)]).layout.priority.tolist() == [0, 1]


def test_a_hop_that_one_uav_can_pay_for_is_enough():
    fleet = make(uav=[{"battery_j": 20.0, "at": "a"}, {"flying_power_w": 0.0, "battery_j": 1.0}]).layout.fleet
    assert fleet.battery_j.tolist() == [20, 1]


def test_a_thousand_devices_and_a_hundred_uavs_are_read_quickly():
    points = np.random.default_rng(0).uniform(0, 800, (1000, 2))
    tables = {"device": [a_device(f"d{number}", x, y) for number, (x, y) in enumerate(points)], "uav": [{}] * 100}
    make_named_scenario(tables, "warm-up")
    began = time.perf_counter()
    scenario = make_named_scenario(tables | {"depot": [{"x_m": 0.0, "y_m": 0.0}]}, "x")
    assert time.perf_counter() - began < 5
    assert (scenario.layout.n_places, scenario.layout.n_uavs) == (1001, 100)
    with pytest.raises(ScenarioError, match=r"holds 1001 devices; give 1 to 1000"):
        make_named_scenario({"device": [a_device(f"d{number}", 1, 1) for number in range(1001)]}, "x")


def test_a_random_scenario_has_uavs_and_a_depot_around_the_same_devices():
    alone, fleet = load_scenario(seed=5), load_scenario(seed=5, uavs=3, depot="charge", settings={"end": "horizon"})
    chex.assert_trees_all_equal(replace(fleet.layout, fleet=None, depots=None), alone.layout)
    assert (alone.layout.fleet, alone.layout.depots) == (None, None)
    chex.assert_trees_all_equal(fleet.draws(3), alone.draws(3))
    assert fleet.name == f"{alone.name}, 3 UAVs, 1 depot"
    assert fleet.params == replace(alone.params, end="horizon")
    assert fleet.layout.depots.kind.tolist() == [DepotKind.CHARGE]
    assert fleet.state.uav_position.tolist() == [[0, 0]] * 3
    assert load_scenario(seed=5, depot="swap").layout.fleet is None


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"uavs": 0}, "uavs is 0; give 1 to 100"),
        ({"uavs": 101}, "uavs is 101; give 1 to 100"),
        ({"depot": "swop"}, "depot is 'swop'; give swap or charge"),
        ({"settings": {"end": "never"}}, "--set: end is 'never'; it should be 'first_failure' or 'horizon'"),
    ],
)
def test_bad_options_of_a_random_scenario_are_refused(options, words):
    with pytest.raises(ScenarioError, match=words):
        load_scenario(**options)

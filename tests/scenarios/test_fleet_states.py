"""State files of fleets: UAVs, depots and failed devices are read, written back, and refused where they do not fit."""

import json
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from tests.scenarios.test_fleet_files import FLEET, make
from tests.scenarios.test_scenario_files import EXAMPLES
from uavmec_jax.env.depots import stands_at
from uavmec_jax.env.dynamics import State, initial_state, transition
from uavmec_jax.errors import StateError
from uavmec_jax.scenarios.load import load_scenario
from uavmec_jax.scenarios.scenario_files import load_scenario_file
from uavmec_jax.scenarios.state_files import load_state, make_state, state_data

HARBOUR = load_scenario_file(FLEET)
"""Two UAVs, gull and tern, a swapping depot with 4 packs, five devices; it ends at its horizon."""
NAMES = HARBOUR.device_names
FIRST_FAILURE = load_scenario_file(FLEET, {"end": "first_failure"})
ONE = make(
    depot=[{"name": "port", "x_m": 12.3, "y_m": 45.6}, {"name": "grid", "x_m": 9.0, "y_m": 9.0, "kind": "charge"}]
)
"""One UAV, two depots, two devices."""


def state_of(data, scenario=HARBOUR):
    return make_state(data, scenario, "now.json")


def read_back(scenario):
    initial = replace(scenario, state=initial_state(scenario.params, scenario.layout))
    return state_of(json.loads(json.dumps(state_data(scenario))), initial)


@pytest.mark.parametrize("scenario", [HARBOUR, FIRST_FAILURE, ONE], ids=["horizon", "first failure", "one UAV"])
def test_empty_file_is_the_initial_state(scenario):
    chex.assert_trees_all_equal(state_of({}, scenario), scenario.state)
    chex.assert_trees_all_equal(read_back(scenario), scenario.state)


def test_uavs_by_name_and_in_order():
    gull = {"at": "lock camera", "energy_j": 1e6}
    tern = {"position_m": [12.5, 40.0], "grounded": True}
    state = state_of({"uavs": {"tern": tern, "gull": gull}, "packs": {"pilot station": 2}, "slot": 3, "elapsed_s": 9.0})
    assert_array_equal(state.uav_position, [HARBOUR.layout.position[2], [12.5, 40]])
    assert_array_equal(state.uav_energy, [1e6, 9e5])
    assert state.grounded.tolist() == [False, True]
    assert state.packs.tolist() == [2]
    chex.assert_trees_all_equal(state_of({"uavs": [gull, tern], "packs": [2], "slot": 3, "elapsed_s": 9.0}), state)
    tern_alone = state_of({"uavs": {"tern": {"energy_j": 0}}})
    assert_array_equal(tern_alone.uav_position, HARBOUR.state.uav_position)
    assert tern_alone.uav_energy.tolist() == [1_600_000, 0]


def test_a_uav_at_a_depot_stands_there():
    state = state_of({"uavs": [{"at": "pilot station"}, {"at": "pilot station"}]})
    assert stands_at(HARBOUR.layout.depots, state.uav_position).tolist() == [[True], [True]]
    data = state_data(replace(HARBOUR, state=state))
    assert data["uavs"]["tern"] == {"at": "pilot station", "energy_j": 900_000, "grounded": False}
    one = state_of({"uav_at": "port", "uav_energy_j": 5.5}, ONE)
    assert stands_at(ONE.layout.depots, one.uav_position).tolist() == [[True, False]]
    chex.assert_trees_all_equal(state_of({"uavs": [{"at": "port", "energy_j": 5.5}]}, ONE), one)


def test_a_uav_without_energy_is_grounded_unless_it_is_at_a_depot():
    first, second = HARBOUR.uav_names
    depot = HARBOUR.depot_names[0]
    state = make_state(
        {"uavs": {first: {"energy_j": 0, "at": NAMES[0]}, second: {"energy_j": 0, "at": depot}}}, HARBOUR, "s"
    )
    assert state.grounded.tolist() == [True, False]


def test_failed_devices_have_no_energy_and_data_of_any_age():
    ages = [3, 400, 0, 0, 99]
    state = state_of({"failed_at": {"quay camera": 3}, "age_slots": ages, "slot": 9, "elapsed_s": 9.0})
    assert state.failed_at.tolist() == [-1, 3, -1, -1, -1]
    assert state.battery[1] == 0
    assert state.age.tolist() == [3, 400, 0, 0, 99]
    data = state_data(replace(HARBOUR, state=state))
    assert data["failed_at"] == {"quay camera": 3}
    assert data["battery_j"]["quay camera"] == 0
    listed = state_of({"failed_at": [-1, 3, -1, -1, -1], "age_slots": ages, "slot": 9, "elapsed_s": 9.0})
    chex.assert_trees_all_equal(listed, state)


def test_only_fleets_depots_and_horizons_have_new_keys():
    today = ["battery_j", "age_slots", "uav_position_m", "uav_energy_j", "slot", "elapsed_s"]
    assert list(state_data(load_scenario_file(EXAMPLES / "harbour.toml"))) == today
    keys = {
        "fleet": list(state_data(make(uav=[{}, {}]))),
        "depots": list(state_data(ONE)),
        "finite packs": list(state_data(make(depot=[{"x_m": 1.0, "y_m": 1.0, "packs": 0}]))),
        "horizon": list(state_data(make(params={"end": "horizon"}))),
    }
    common, rest = ["battery_j", "age_slots", "uavs"], ["slot", "elapsed_s"]
    assert keys == {
        "fleet": [*common, *rest],
        "depots": [*common, *rest],
        "finite packs": [*common, "packs", *rest],
        "horizon": [*common, *rest],
    }


def test_a_state_after_some_slots_is_read_back_to_the_bit(tmp_path):
    layout = replace(HARBOUR.layout, capacity=HARBOUR.layout.capacity.at[1].set(1_500.0))
    scenario = replace(HARBOUR, layout=layout, state=state_of({}))
    scenario = replace(scenario, state=replace(scenario.state, battery=layout.capacity))
    state, key = scenario.state, jax.random.key(0)
    for slot, action in enumerate([[0, 5], [2, 4], [5, 5], [3, 5]]):
        volumes = jax.random.uniform(jax.random.fold_in(key, slot), (5,), minval=2e6, maxval=4e6)
        state, _ = jax.jit(transition)(scenario.params, layout, state, jnp.array(action), volumes)
    assert state.failed_at.tolist() == [-1, 1, -1, -1, -1]
    assert state.packs.tolist() < [4]
    (tmp_path / "now.json").write_text(json.dumps(state_data(replace(scenario, state=state))))
    chex.assert_trees_all_equal(load_state(tmp_path / "now.json", scenario), state)


unit = st.floats(0, 1, width=32)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_state_is_read_back_to_the_bit(data):
    scenario = data.draw(st.sampled_from([HARBOUR, FIRST_FAILURE, ONE]))
    layout, horizon = scenario.layout, scenario.params.end == "horizon"
    draw = lambda strategy, count: data.draw(st.lists(strategy, min_size=count, max_size=count))  # noqa: E731
    n, uavs, slot = layout.n_devices, layout.n_uavs, data.draw(st.integers(0, 50))
    failed = np.array(draw(st.booleans(), n)) & horizon
    capacity = np.asarray(scenario.state.uav_energy)
    places, chosen = np.asarray(layout.places()), draw(st.integers(0, layout.n_places), uavs)
    anywhere = np.array(draw(st.tuples(unit, unit), uavs), np.float32) * np.float32(500)
    battery = np.asarray(layout.capacity) * np.maximum(np.array(draw(unit, n), np.float32), np.float32(1e-3))
    state = State(
        battery=jnp.where(failed, 0.0, battery),
        age=jnp.where(layout.has_comms, 0, jnp.array(draw(st.integers(0, 40 if horizon else 10), n))),
        uav_position=jnp.array(
            np.where(np.array(chosen)[:, None] < len(places), places[np.array(chosen) % len(places)], anywhere)
        ),
        uav_energy=jnp.array(capacity * np.array(draw(unit, uavs), np.float32)),
        slot=jnp.int32(slot),
        elapsed=jnp.float32(data.draw(unit) * 21_000),
        grounded=jnp.array(draw(st.booleans(), uavs)),
        failed_at=jnp.where(failed, jnp.array(draw(st.integers(0, slot), n)), -1),
        packs=jnp.array(
            [data.draw(st.sampled_from([0, 1, has])) if has < np.inf else has for has in scenario.state.packs.tolist()],
            jnp.float32,
        ),
    )
    chex.assert_trees_all_equal(read_back(replace(scenario, state=state)), state)


def test_a_random_scenario_takes_a_state_file(tmp_path):
    (tmp_path / "now.json").write_text('{"uavs": {"uav 2": {"at": "device 3"}}}')
    scenario = load_scenario(state=tmp_path / "now.json", uavs=2, depot="swap")
    assert_allclose(scenario.state.uav_position, [[0, 0], scenario.layout.position[2]])


NAN = float("nan")
GULL = "uav 1 (gull): "


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (
            {"uav_at": NAMES[0]},
            "uav_at is given, but there are 2 UAVs; give uavs: their names, each with at, energy_j, ...",
        ),
        ({"uav_energy_j": 5.0}, "uav_energy_j is given, but there are 2 UAVs"),
        ({"uavs": [{}]}, "uavs has 1 values; give 2, one for each UAV"),
        ({"uavs": {"bull": {}}}, "uavs names 'bull'; the UAVs are gull, tern"),
        ({"uavs": {"": {}}}, "uavs names ''; the UAVs are gull, tern"),
        ({"uavs": {"gull": {"at": "nowhere"}}}, f"{GULL}at is 'nowhere'; the places are hospital, quay camera, "),
        ({"uavs": [{}, {"at": "tern"}]}, "uav 2 (tern): at is 'tern'; the places are"),
        (
            {"uavs": {"gull": {"at": NAMES[0], "position_m": [0, 0]}}},
            f"{GULL}at and position_m are both given; leave one",
        ),
        (
            {"uavs": {"gull": {"position_m": [NAN, 0]}}},
            f"{GULL}position_m is [nan, 0.0]; give metres in or near the region",
        ),
        ({"uavs": {"gull": {"position_m": [1e4, 0]}}}, f"{GULL}position_m is [10000.0, 0.0]; give metres"),
        ({"uavs": {"gull": {"energy_j": 2e6}}}, f"{GULL}energy_j is 2e+06; give from 0 to 1.6e+06"),
        ({"uavs": [{}, {"energy_j": 1e6}]}, "uav 2 (tern): energy_j is 1e+06; give from 0 to 900000"),
        ({"uavs": {"gull": {"energy_j": -1}}}, f"{GULL}energy_j is -1; give from 0 to"),
        ({"uavs": {"gull": {"energy_j": NAN}}}, f"{GULL}energy_j is nan; give from 0 to"),
        ({"uavs": {"gull": {"energy_j": "full"}}}, "uavs.gull.energy_j is 'full'; it should be a number"),
        ({"uavs": {"gull": {"grounded": 1}}}, "uavs.gull.grounded is 1; it should be true or false"),
        ({"uavs": [{"energi_j": 1}, {}]}, "uavs.gull.energi_j is not a setting; did you mean 'energy_j'?"),
        ({"uavs": 3}, "uavs is 3; it should be"),
        ({"packs": {"port": 1}}, "packs names 'port'; the depots are pilot station"),
        ({"packs": [1, 2]}, "packs has 2 values; give 1, one for each depot"),
        (
            {"packs": [5]},
            "depot 1 (pilot station): packs is 5; give a whole number from 0 to 4, its stock at the start",
        ),
        ({"packs": [1.5]}, "depot 1 (pilot station): packs is 1.5; give a whole number"),
        ({"packs": [NAN]}, "depot 1 (pilot station): packs is nan; give a whole number"),
        ({"failed_at": {"nobody": 1}}, "failed_at names 'nobody'; the devices are"),
        (
            {"failed_at": {NAMES[1]: 4}, "slot": 3},
            f"device 2 ({NAMES[1]}): failed_at is 4; give 0 to 3, the number of comp",
        ),
        (
            {"failed_at": {NAMES[1]: -2}},
            f"device 2 ({NAMES[1]}): failed_at is -2; give 0 to 0, the number of completed",
        ),
        (
            {"failed_at": {NAMES[1]: 0}, "battery_j": {NAMES[1]: 5.0}},
            f"device 2 ({NAMES[1]}): battery_j is 5, but failed_at is given; leave one of them out",
        ),
        (
            {"battery_j": {NAMES[0]: 0.0}},
            "battery_j is 0; give more than 0 and at most 71000, its capacity, or failed_at if",
        ),
        ({"age_slots": {NAMES[0]: -1}}, f"device 1 ({NAMES[0]}): age_slots is -1; give 0 to 1000000"),
        (
            {"age_slots": {NAMES[0]: 10**12}},
            f"age_slots.{NAMES[0]} is 1000000000000; it should be less than or equal to 2147483647",
        ),
        ({"elapsed_s": 30_000}, "elapsed_s is 30000; the horizon is 21600 s; give less"),
        ({"slot": 3}, "elapsed_s is missing, but slot is 3; give the seconds that these slots took"),
        ({"slot": 1000, "elapsed_s": 9.0}, "slot is 1000; episodes end after params.max_slots = 1000 slots; give less"),
        ({"slot": 10**12}, "slot is 1000000000000; it should be less than or equal to 1000000"),
    ],
)
def test_bad_state_is_refused_in_one_line(data, words):
    refused(data, HARBOUR, words)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"uav_at": "port", "uavs": [{}]}, "uav_at is given, and uavs too; leave one of them out"),
        ({"uav_at": "b", "uav_position_m": [0, 0]}, "uav_at and uav_position_m are both given; leave one of them out"),
        ({"uav_at": "quay"}, "uav_at is 'quay'; the places are a, b, port, grid"),
        ({"uav_energy_j": -1}, "uav_energy_j is -1; give from 0 to 1.6e+06"),
        ({"packs": {"port": -1}}, "depot 1 (port): packs is -1; give a whole number from 0"),
        (
            {"packs": {"grid": 2}},
            "depot 2 (grid): packs is 2, but it charges batteries; give packs by name, without this depot",
        ),
        ({"packs": [1, 0]}, "depot 2 (grid): packs is 0, but it charges batteries; give packs by name, without this"),
        (
            {"failed_at": {"a": 0}},
            "failed_at is given, but the first failure ends the episode; leave it out, or give par",
        ),
        ({"age_slots": {"a": 11}}, "device 1 (a): age_slots is 11; give 0 to 10: older data have expired"),
    ],
)
def test_bad_state_of_one_uav_is_refused_in_one_line(data, words):
    refused(data, ONE, words)


def test_packs_need_depots():
    refused({"packs": [1]}, make(), "packs is given, but there are no depots; leave it out")


def refused(data, scenario, words):
    with pytest.raises(StateError) as error:
        state_of(data, scenario)
    message = str(error.value)
    assert words in message
    assert message.startswith("now.json: ")
    assert "\n" not in message

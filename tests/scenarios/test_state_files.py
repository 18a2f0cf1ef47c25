"""State files: the present state is read and written back, and refused in one line where it does not fit."""

import json
from dataclasses import replace

import chex
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.scenarios.test_scenario_files import EXAMPLES
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.errors import StateError
from uavmec_jax.scenarios.scenario_files import load_scenario_file
from uavmec_jax.scenarios.state_files import load_state, make_state, state_data

HARBOUR = load_scenario_file(EXAMPLES / "harbour.toml")
NAMES = HARBOUR.device_names
CAPACITY = np.asarray(HARBOUR.layout.capacity, float).tolist()


def state_of(data):
    return make_state({k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}, HARBOUR, "now.json")


def test_empty_file_is_the_initial_state():
    chex.assert_trees_all_equal(state_of({}), initial_state(HARBOUR.params, HARBOUR.layout))


def test_values_by_position_and_by_name():
    ages = [1, 2, 3, 4, 5, 6]
    listed = state_of({"battery_j": [c / 2 for c in CAPACITY], "age_slots": ages, "uav_energy_j": 900_000, "slot": 7})
    assert_allclose(listed.battery, np.array(CAPACITY) / 2, rtol=1e-6)
    assert_array_equal(
        listed.age, np.where(HARBOUR.layout.has_comms, 0, ages)
    )  # connected devices deliver by themselves
    assert (float(listed.uav_energy[0]), int(listed.slot)) == (900_000, 7)
    named = state_of({"battery_j": {NAMES[2]: 1234.0}, "uav_at": NAMES[1]})
    assert_allclose(named.battery, [*CAPACITY[:2], 1234.0, *CAPACITY[3:]], rtol=1e-6)
    assert_array_equal(named.uav_position[0], HARBOUR.layout.position[1])


def test_round_trip(tmp_path):
    state = state_of({"battery_j": [c / 3 for c in CAPACITY], "uav_position_m": [12.5, 40.0], "slot": 3})
    (tmp_path / "now.json").write_text(json.dumps(state_data(replace(HARBOUR, state=state))))
    chex.assert_trees_all_close(load_state(tmp_path / "now.json", HARBOUR), state, rtol=1e-5, atol=1e-2)


NAN = float("nan")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"age_slots": [1, 2]}, "age_slots has 2 values; give 6, one for each device"),
        ({"battery_j": [1.0] * 7}, "battery_j has 7 values; give 6"),
        ({"battery_j": [CAPACITY[0] + 5, *CAPACITY[1:]]}, f"device 1 ({NAMES[0]}): battery_j is"),
        ({"battery_j": [*CAPACITY[:5], NAN]}, f"device 6 ({NAMES[5]}): battery_j is nan; give more than 0 and at most"),
        ({"battery_j": [*CAPACITY[:5], 0.0]}, "battery_j is 0; give more than 0"),
        ({"battery_j": {"nobody": 5.0}}, "battery_j names 'nobody'; the devices are"),
        ({"age_slots": [0, -1, 0, 0, 0, 0]}, f"device 2 ({NAMES[1]}): age_slots is -1; give 0 to 10"),
        ({"age_slots": [0, 0, 11, 0, 0, 0]}, "age_slots is 11; give 0 to 10: older data have expired"),
        ({"age_slots": [0, 0, 1.5, 0, 0, 0]}, "age_slots"),
        ({"uav_energy_j": NAN}, "uav_energy_j is nan; give more than 0"),
        ({"uav_energy_j": 2e6}, "uav_energy_j is 2e+06; give more than 0 and at most 1.2e+06"),
        ({"uav_at": "nowhere"}, "uav_at is 'nowhere'; the devices are"),
        ({"uav_at": NAMES[0], "uav_position_m": [0.0, 0.0]}, "are both given; leave one of them out"),
        ({"uav_position_m": [NAN, 0.0]}, "uav_position_m is [nan, 0.0]; give metres"),
        ({"uav_position_m": [1e6, 0.0]}, "uav_position_m is [1000000.0, 0.0]; give metres"),
        ({"slot": -1}, "slot is -1"),
        ({"batery_j": []}, "batery_j is not a setting; did you mean 'battery_j'?"),
    ],
)
def test_bad_state_is_refused_in_one_line(data, words):
    with pytest.raises(StateError) as error:
        state_of(data)
    message = str(error.value)
    assert words in message
    assert message.startswith("now.json: ")
    assert "\n" not in message


def test_missing_file_and_no_json_object(tmp_path):
    path = tmp_path / "now.json"
    with pytest.raises(StateError, match=r"now\.json"):
        load_state(path, HARBOUR)
    for text, words in (("{", "not JSON"), ("[1]", "holds a list; it should hold an object")):
        path.write_text(text)
        with pytest.raises(StateError, match=words):
            load_state(path, HARBOUR)

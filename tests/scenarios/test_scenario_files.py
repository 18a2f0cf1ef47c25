"""Scenario files: what users write about their devices is read, written back, and refused where it is wrong."""

from pathlib import Path

import chex
import numpy as np
import pytest
from numpy.testing import assert_allclose

from uavmec_jax.env.hardware import ACTIVE_POWER_W, PROCESSING_RATE_BYTES_S, STANDBY_POWER_W, UNLISTED
from uavmec_jax.env.params import Params
from uavmec_jax.errors import ScenarioError
from uavmec_jax.scenarios.named_scenario import name_scenario
from uavmec_jax.scenarios.scenario_files import load_scenario_file, scenario_text
from uavmec_jax.scenarios.seeds import layout_for_seed

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
DEVICE = """
[[device]]
name = "a"
x_m = 1.0
y_m = 1.0
type = "Firefly"
task = "DNN"
capacity_j = 5e4
"""


def write(tmp_path, text, name="scenario.toml"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_degrees_become_metres_and_given_hardware_is_used():
    harbour = load_scenario_file(EXAMPLES / "harbour.toml")
    assert harbour.device_names[2] == "tide gauge"
    layout = harbour.layout
    assert layout.device_type.tolist() == [3, 0, UNLISTED, 2, 4, 2]
    assert_allclose([layout.standby_power[2], layout.active_power[2], layout.processing_rate[2]], [1.2, 0.8, 9000.0])
    assert_allclose(layout.standby_power[0], STANDBY_POWER_W[3])
    assert_allclose(layout.active_power[0], ACTIVE_POWER_W[4, 3])
    assert_allclose(layout.processing_rate[1], PROCESSING_RATE_BYTES_S[2, 0])
    assert harbour.params.uav_battery_j == 1.2e6
    assert harbour.params.n_devices == 6
    # One degree of latitude is 111.2 km; a degree of longitude shrinks with the cosine of the latitude.
    north = (53.5472 - 53.5430) * 111_195.0
    east = (9.9935 - 9.9848) * 111_195.0 * np.cos(np.radians(53.543))
    assert_allclose(harbour.params.region_m, [east, north], rtol=1e-4)
    assert_allclose(layout.position.min(axis=0), 0.0, atol=1e-3)
    assert_allclose(harbour.geographic(np.asarray(layout.position))[4], [9.9880, 53.5455], atol=1e-6)


def test_toml_round_trip(tmp_path):
    harbour = load_scenario_file(EXAMPLES / "harbour.toml")
    again = load_scenario_file(write(tmp_path, scenario_text(harbour)))
    assert again.file == harbour.file
    chex.assert_trees_all_equal(again.layout, harbour.layout)


def test_csv_round_trip(tmp_path):
    village = load_scenario_file(EXAMPLES / "village.csv")
    assert village.layout.has_power.tolist() == [False, False, True, False]
    again = load_scenario_file(write(tmp_path, scenario_text(village, ".csv"), "village.csv"))
    assert again.file == village.file
    as_toml = load_scenario_file(write(tmp_path, scenario_text(village), "village.toml"))
    chex.assert_trees_all_equal(as_toml.layout, village.layout)
    with pytest.raises(ScenarioError, match="a CSV has no place for params"):
        scenario_text(load_scenario_file(EXAMPLES / "harbour.toml"), ".csv")


def test_random_scenario_round_trip(tmp_path):
    params = Params(region_m=(500.0, 300.0))
    layout = layout_for_seed(4, params, 5, 7)
    again = load_scenario_file(write(tmp_path, scenario_text(name_scenario(layout, params, "random"))))
    chex.assert_trees_all_equal(again.layout, layout)
    assert again.params == params


def test_degrees_need_an_origin():
    with pytest.raises(ScenarioError, match="has no place on the map; give origin"):
        load_scenario_file(EXAMPLES / "village.csv").geographic(np.zeros(2))


BAD = {
    "no device": ('name = "x"', "holds 0 devices; give 1 to 1000"),
    "outside": (
        DEVICE.replace("x_m = 1.0", "x_m = 900.0"),
        "device 1 (a): lies at 900, 1 m, outside the region of 800 x",
    ),
    "twice": (DEVICE + DEVICE, "device 2: name is 'a', which another device has"),
    "type": (
        DEVICE.replace("Firefly", "Fireflyy"),
        "type is 'Fireflyy', which the tables do not list; did you mean 'Fir",
    ),
    "no type": (DEVICE.replace('type = "Firefly"', ""), "type is missing; or give standby_power_w, active_power_w"),
    "half given": (
        DEVICE.replace("Firefly", "x") + "active_power_w = 1.0",
        "type is 'x', which the tables do not list",
    ),
    "capacity": (
        DEVICE.replace("5e4", "0"),
        "device 1 (a): capacity_j is 0; it should be greater than or equal to 0.001",
    ),
    "no capacity": (DEVICE.replace("capacity_j = 5e4", ""), "device 1 (a): capacity_j is missing"),
    "hop": (
        "[params]\nuav_battery_j = 10.0\n" + DEVICE,
        "the hop from the start to a, 1 m, takes 0 kJ; the UAV's battery",
    ),
    "field": (DEVICE + "colour = 3", "device 1 (a): colour is not a setting"),
    "param": (
        "[params]\nuav_batery_j = 3.0\n" + DEVICE,
        "params.uav_batery_j is not a setting; did you mean 'uav_battery_j'?",
    ),
    "place": (DEVICE.replace("x_m = 1.0", ""), "device 1 (a): position is unclear; give x_m and y_m, or lon and lat"),
    "both": (DEVICE + "lon = 3.0\nlat = 4.0", "device 1 (a): position is unclear"),
    "nan": (DEVICE.replace("x_m = 1.0", "x_m = nan"), "x_m is nan; it should be a finite number"),
    "count": ("[params]\nn_devices = 3\n" + DEVICE, "params.n_devices is 3, but there are 1 devices; leave it out"),
    "range": (
        "[params]\ntask_volume_range_bytes = [4e6, 2e6]\n" + DEVICE,
        "params.task_volume_range_bytes is [4000000.0, 2",
    ),
    "origin": ("origin = [9.9, 95.0]\n" + DEVICE, "origin: item 2 is 95.0; it should be less than or equal to 89"),
    "toml": ("[[device]", "not TOML"),
    "table": ("device = [3]", "device 1 (3): "),
}


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD)
def test_bad_scenario_is_refused_in_one_line(tmp_path, text, message):
    with pytest.raises(ScenarioError) as error:
        load_scenario_file(write(tmp_path, text))
    assert message in str(error.value)
    assert str(error.value).startswith(str(tmp_path / "scenario.toml"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "name,x_m,y_m,type,task,capacity_j\na,1,2,Firefly,DNN,abc\n",
            "capacity_j is 'abc'; it should be a number",
        ),
        ("name,x_m,y_m,type,task,capacity_j,power\na,1,2,Firefly,DNN,5,maybe\n", "power is 'maybe'"),
        ("name,x_m\na,1,2,3\n", "line 2 has 4 cells; there are 2 columns"),
        ("", "is empty; its first line should name its columns"),
        ("name,x_m,y_m,type,task,capacity_j\n", "holds 0 devices"),
    ],
)
def test_bad_csv_is_refused_in_one_line(tmp_path, text, message):
    with pytest.raises(ScenarioError) as error:
        load_scenario_file(write(tmp_path, text, "scenario.csv"))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_file_and_unknown_format(tmp_path):
    with pytest.raises(ScenarioError, match=r"cannot be read: No such file"):
        load_scenario_file(tmp_path / "none.toml")
    with pytest.raises(ScenarioError, match=r"ends in .toml or .csv"):
        load_scenario_file(tmp_path / "none.json")

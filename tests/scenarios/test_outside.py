"""What users hand in as scenarios and states: whatever it is, it is read as it was meant, or refused in one line."""

import json
import os
import time

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tests.scenarios.test_scenario_files import DEVICE, EXAMPLES, write
from uavmec_jax.errors import ScenarioError, StateError
from uavmec_jax.scenarios.load import load_scenario
from uavmec_jax.scenarios.scenario_files import load_scenario_file, scenario_text
from uavmec_jax.scenarios.state_files import load_state

COMMAS = (
    "name,lon,lat,type,task,capacity_j\nnorth,9.98,53.54,Firefly,HAAR,60000\nsouth,9.981,53.541,Firefly,HAAR,60000\n"
)


def refused(path, read=load_scenario_file, error=ScenarioError):
    """Return what is said about a file, after checking that it is one line that names it, and said at once."""
    started = time.monotonic()
    with pytest.raises(error) as caught:
        read(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ".replace("\0", "\\x00"))
    assert message.isprintable()
    assert len(message) <= 400
    assert time.monotonic() - started < 10
    return message


@pytest.mark.parametrize("separator", [";", "\t", "; "])
def test_a_table_with_semicolons_or_tabs_is_read(tmp_path, separator):
    expected = load_scenario_file(write(tmp_path, COMMAS, "same.csv"))
    read = load_scenario_file(write(tmp_path, COMMAS.replace(",", separator), "same.csv"))
    assert read.file == expected.file


def test_a_table_without_the_columns_of_devices_names_those_it_has_and_those_it_wants(tmp_path):
    message = refused(write(tmp_path, "id,height\n1,20\n", "towers.csv"))
    assert (
        "has the columns id, height; a device needs name, capacity_j, and x_m and y_m or lon and lat; known: "
        in message
    )
    assert "standby_power_w" in message


def test_an_unknown_column_beside_the_known_ones_is_named(tmp_path):
    message = refused(write(tmp_path, COMMAS.replace("type", "typ"), "towers.csv"))
    assert message.endswith("towers.csv: typ is not a setting; did you mean 'type'?")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("9.981", "9,981", "line 3 has 7 cells; there are 6 columns"),
        ("9.981", "east", "device 2 (south): lon is 'east'; it should be a number"),
        ("9.981", "nan", "device 2 (south): lon is nan; it should be a finite number"),
        ("south", "", "device 2 (no name): name is missing"),
        ("south", "north", "device 2: name is 'north', which another device has"),
        ("60000\n", "60000\n\n\n", None),
        ("south", "x" * 200_000, "line 3 has a longer cell than 10,000 characters"),
        ("south", "x" * 20_000, "line 3 has a cell of 20,000 characters"),
        ("south", '"so', "line 3 is not CSV"),
    ],
)
def test_a_row_that_is_not_right_is_named(tmp_path, old, new, message):
    path = write(tmp_path, COMMAS.replace(old, new), "devices.csv")
    if message is None:
        assert load_scenario_file(path).device_names == ["north", "south"]
    else:
        assert message in refused(path)


def test_a_decimal_comma_among_semicolons_is_named(tmp_path):
    path = write(tmp_path, COMMAS.replace(",", ";").replace("9.981", "9,981"), "devices.csv")
    assert "device 2 (south): lon is '9,981'; it should be a number" in refused(path)


DEEP = "[" * 20_000 + "]" * 20_000
BAD_TOML = {
    "5,000 digits": (DEVICE.replace("5e4", "9" * 5000), "a whole number has more than 40 digits"),
    "4,000 digits": (DEVICE.replace("5e4", "9" * 4000), "a whole number of more than 40 digits"),
    "20,000 brackets": (f"region = {DEEP}\n{DEVICE}", "is nested too deep"),
    "20,000 tables": (f"{DEVICE}\n{'a.' * 20_000}a = 1\n", "is nested too deep"),
    "tiny capacity": (
        DEVICE.replace("5e4", "1e-300"),
        "device 1 (a): capacity_j is 1e-300; it should be greater than or",
    ),
    "huge capacity": (
        DEVICE.replace("5e4", "1e300"),
        "device 1 (a): capacity_j is 1e+300; it should be at most 1e+12 in",
    ),
    "negative position": (
        DEVICE.replace("x_m = 1.0", "x_m = -5.0"),
        "device 1 (a): lies at -5, 1 m, outside the region",
    ),
    "absurd position": (
        DEVICE.replace("x_m = 1.0", "x_m = 1e30"),
        "x_m is 1e+30; it should be less than or equal to 1000",
    ),
    "tiny power": (
        f"{DEVICE}standby_power_w = 1e-300\n",
        "standby_power_w is 1e-300; it should be 0, or at least 1e-12",
    ),
    "huge rate": (
        f"{DEVICE}processing_rate_bytes_s = 1e300\n",
        "processing_rate_bytes_s is 1e+300; it should be at most",
    ),
    "slow": (f"[params]\nuav_speed_m_s = 1e-320\n{DEVICE}", "params.uav_speed_m_s is "),
    "endless": (f"[params]\nhorizon_s = 1e300\n{DEVICE}", "params.horizon_s is 1e+300; it should be "),
    "many pads": (
        f"{DEVICE}[[depot]]\nx_m = 1.0\ny_m = 1.0\npads = 1e300\n",
        "pads is 1e+300; it should be at most 1e+12",
    ),
    "no name": (DEVICE.replace('"a"', '""'), "name is ''; it should have at least 1 character"),
    "long name": (DEVICE.replace('"a"', f'"{"a" * 81}"'), "should have at most 80 characters"),
    "terminal's name": (
        DEVICE.replace('"a"', '"\\u001b[2J"'),
        "it should be one line of characters that can be printed",
    ),
    "name of the scenario": (f'name = "a\\nb"\n{DEVICE}', "name is 'a\\nb'; it should be one line"),
    "array as a number": (
        DEVICE.replace("5e4", "[1, 2]"),
        "device 1 (a): capacity_j is [1, 2]; it should be a number",
    ),
    "table as a list": ("device = 3\n", "device is 3; it should be an array"),
    "number as params": (f"params = 3\n{DEVICE}", "params is 3; it should be a table"),
}


@pytest.mark.parametrize(("text", "message"), BAD_TOML.values(), ids=BAD_TOML)
def test_a_scenario_file_that_cannot_be_is_refused_in_one_line(tmp_path, text, message):
    assert message in refused(write(tmp_path, text))


@pytest.mark.parametrize("ending", [".toml", ".csv"])
def test_what_is_no_regular_file_or_no_text_is_refused_at_once(tmp_path, ending):
    fifo = tmp_path / f"fifo{ending}"
    os.mkfifo(fifo)
    assert "is not a regular file" in refused(fifo)
    (tmp_path / f"folder{ending}").mkdir()
    refused(tmp_path / f"folder{ending}")
    (tmp_path / f"latin{ending}").write_bytes(DEVICE.replace('"a"', '"å"').encode("latin-1"))
    assert "is not UTF-8" in refused(tmp_path / f"latin{ending}")
    assert "null byte" in refused(tmp_path / f"nul\0{ending}")
    (tmp_path / f"long{ending}").write_bytes(b"#" * (16 * 2**20 + 1))
    assert "is longer than 16 MiB" in refused(tmp_path / f"long{ending}")


@pytest.mark.parametrize("settings", [{"name.x": 1}, {"": 1}, {"uav_speed_m_s": [1]}, {"max_slots": 10**39}])
def test_a_setting_that_cannot_be_is_refused_in_one_line(settings):
    for file in (None, EXAMPLES / "village.csv"):
        with pytest.raises(ScenarioError):
            load_scenario(file, settings=settings)


HARBOUR = load_scenario_file(EXAMPLES / "harbour.toml")
BAD_STATES = {
    "slot": ('{"slot": 99999999999999}', "slot is 99999999999999; it should be less than or equal to 1000000"),
    "age": ('{"age_slots": {"quay camera": 99999999999999}}', "age_slots.quay camera is 99999999999999"),
    "digits": (f'{{"slot": {"9" * 5000}}}', "a whole number has more than 40 digits"),
    "elapsed": ('{"elapsed_s": 1e300}', "elapsed_s is 1e+300; it should be less than or equal to 1000000000000"),
    "infinite": ('{"elapsed_s": 1e999}', "1e999 is too large for a number"),
    "nan": ('{"battery_j": [NaN]}', "it holds NaN"),
    "twice": ('{"slot": 1, "slot": 2}', "'slot' is given twice"),
    "deep": ("[" * 200_000, "is nested too deep"),
    "deep in an object": (f'{{"battery_j": {"[" * 20_000}{"]" * 20_000}}}', "is nested too deep"),
    "text": ('{"battery_j": "full"}', "battery_j is 'full'"),
    "truth": ('{"slot": true}', "slot is True; it should be a whole number"),
    "uavs": ('{"uavs": [3]}', "uavs"),
    "null": ("null", "holds null; it should hold an object"),
    "empty": ("", "not JSON"),
    "control": ('{"\\u001b[2J": 1}', "is not a setting"),
}


@pytest.mark.parametrize(("text", "message"), BAD_STATES.values(), ids=BAD_STATES)
def test_a_state_file_that_cannot_be_is_refused_in_one_line(tmp_path, text, message):
    path = write(tmp_path, text, "now.json")
    assert message in refused(path, lambda file: load_state(file, HARBOUR), StateError)


SHORES = (("west shore", 179.9985, -16.780), ("road post", 179.9999, -16.782), ("east shore", -179.9990, -16.781))
"""Three devices on Taveuni, Fiji, on both sides of the antimeridian."""


def shores(tmp_path, longitude=lambda lon: lon, *, origin=False, ending=".csv", region=()):
    """Return the scenario of the three shores, with the longitudes written in another way."""
    placed = [(name, longitude(lon), lat) for name, lon, lat in SHORES]
    if ending == ".csv":
        rows = [f"{name},{lon},{lat},Firefly,HAAR,60000" for name, lon, lat in placed]
        return load_scenario_file(
            write(tmp_path, "\n".join(["name,lon,lat,type,task,capacity_j", *rows]), "shores.csv")
        )
    head = ["origin = [179.998, -16.783]\n[params]\nregion_m = [500.0, 500.0]"] if origin else []
    head += [f"region = {json.dumps(region)}"] if region else []
    device = '[[device]]\nname = "{}"\nlon = {}\nlat = {}\ntype = "Firefly"\ntask = "HAAR"\ncapacity_j = 60000.0'
    return load_scenario_file(write(tmp_path, "\n".join(head + [device.format(*it) for it in placed])))


def hops(scenario):
    """Return the distances from each device to the next, m."""
    position = np.asarray(scenario.layout.position, float)
    return np.hypot(*np.diff(position, axis=0).T)


def test_a_hop_over_the_antimeridian_is_short(tmp_path):
    scenario = shores(tmp_path)
    assert_array_equal(np.round(hops(scenario)), [268, 161])
    assert scenario.origin == (179.9985, -16.782)
    longitudes = scenario.geographic(np.asarray(scenario.layout.position))[:, 0]
    assert np.allclose(longitudes, [179.9985, 179.9999, -179.9990], rtol=0, atol=1e-6)


def test_longitudes_of_180_to_360_are_the_same_places(tmp_path):
    scenario = shores(tmp_path, lambda lon: round(lon % 360.0, 4))
    assert scenario.file == shores(tmp_path).file
    assert [device.lon for device in scenario.file.device] == [179.9985, 179.9999, -179.999]
    again = load_scenario_file(write(tmp_path, scenario_text(scenario)))
    assert_array_equal(again.layout.position, scenario.layout.position)


@pytest.mark.parametrize("far_west", [-179.9999, 180.0001])
def test_everything_just_east_of_the_antimeridian(tmp_path, far_west):
    scenario = shores(tmp_path, lambda lon: far_west + (lon - 179.9985) % 360.0)
    assert scenario.origin == (-179.9999, -16.782)
    assert_array_equal(np.round(hops(scenario)), [268, 161])


def test_the_first_device_may_lie_east_of_the_antimeridian(tmp_path):
    rows = (
        "name,lon,lat,type,task,capacity_j\ne,-179.999,-16.781,Firefly,HAAR,6e4\nw,179.9985,-16.78,Firefly,HAAR,6e4\n"
    )
    scenario = load_scenario_file(write(tmp_path, rows, "two.csv"))
    assert scenario.origin == (179.9985, -16.781)
    assert_array_equal(np.round(hops(scenario)), [288])


def test_an_origin_west_of_the_antimeridian_counts_metres_across_it(tmp_path):
    scenario = shores(tmp_path, origin=True, ending=".toml")
    assert scenario.origin == (179.998, -16.783)
    assert_array_equal(np.round(np.asarray(scenario.layout.position)[:, 0]), [53, 202, 319])


def test_metres_across_the_antimeridian_come_out_within_180_degrees(tmp_path):
    text = f"origin = [179.998, -16.783]\n{DEVICE.replace('x_m = 1.0', 'x_m = 320.0')}"
    scenario = load_scenario_file(write(tmp_path, text))
    assert np.allclose(scenario.geographic(np.asarray(scenario.layout.position))[0, 0], -179.998994, rtol=0, atol=1e-5)
    assert abs(scenario.geographic(np.array([320.0, 1.0]))[0]) <= 180


@pytest.mark.parametrize("east", [-179.998, 180.002])
def test_a_region_across_the_antimeridian(tmp_path, east):
    region = [[179.998, -16.783], [east, -16.783], [east, -16.779], [179.998, -16.779]]
    scenario = shores(tmp_path, ending=".toml", region=region)
    assert np.allclose(scenario.params.region_m, [425.8, 444.8], rtol=0, atol=0.1)
    again = load_scenario_file(write(tmp_path, scenario_text(scenario)))
    assert_array_equal(again.layout.position, scenario.layout.position)
    assert all(abs(lon) <= 180 for lon, _ in again.file.region)


def test_a_longitude_beyond_360_is_refused(tmp_path):
    path = write(tmp_path, COMMAS.replace("9.981", "369.981"), "far.csv")
    assert "device 2 (south): lon is 369.981; it should be less than or equal to 360" in refused(path)

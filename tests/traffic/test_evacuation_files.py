"""Files of evacuations with a right checksum and wrong content: one line that names the field and the device."""

import os
from dataclasses import fields, replace

import numpy as np
import pytest
from click.testing import CliRunner

from tests.deadlines import within
from tests.traffic.networks import evacuation
from uavmec_jax.cli import main
from uavmec_jax.errors import TrafficError
from uavmec_jax.files.archives import write_checked
from uavmec_jax.traffic.evacuation import Evacuation, load_evacuation

NAN, INF = float("nan"), float("inf")


def write(path, meta=None, **arrays):
    """Write an evacuation with some facts and arrays replaced, and a right checksum; ``None`` leaves a fact out."""
    good = evacuation()
    facts = {name: value for name, value in (good.meta | (meta or {})).items() if value is not None}
    contents = {field.name: getattr(good, field.name) for field in fields(Evacuation) if field.name != "meta"}
    write_checked(path, 1, {"meta": facts}, contents | arrays)
    return path


def changed(name, index, value, dtype=None):
    """Return an array of the evacuation with one number replaced."""
    array = getattr(evacuation(), name).astype(dtype or getattr(evacuation(), name).dtype)
    array[index] = value
    return {name: array}


BAD_ARRAYS = {
    "NaN position": (changed("position", (1, 0), NAN), "position of device 2 (site 2) is nan; it should be a number"),
    "infinite position": (changed("position", (2, 1), -INF), "position of device 3 (site 3) is -inf"),
    "position off the Earth": (changed("position", (0, 0), 2e7), "position of device 1 (site 1) is 2e+07"),
    "NaN weight": (changed("weight", 2, NAN), "weight of device 3 (site 3) is nan; it should be a number from 0 to 1"),
    "negative weight": (changed("weight", 0, -0.5), "weight of device 1 (site 1) is -0.5"),
    "weight of 1e30": (
        changed("weight", 1, 1e30),
        "weight of device 2 (site 2) is 1e+30; it should be a number from 0",
    ),
    "weight in a window": (
        changed("window_weight", (1, 2), 1.5),
        "window_weight of device 3 (site 3) in window 2 is 1.5",
    ),
    "NaN density": (changed("density", 1, NAN), "density of device 2 (site 2) is nan"),
    "negative density": (changed("density", 0, -1), "density of device 1 (site 1) is -1"),
    "negative spread": (changed("density_spread", 0, -1), "density_spread of device 1 (site 1) is -1"),
    "density of a road": (changed("road_density", (0, 1), INF), "road_density of road 2 (b) in window 1 is inf"),
    "corner": (changed("road_shape", (3, 0), NAN), "road_shape of corner 4 is nan"),
    "one corner": (changed("road_corners", 0, 1), "road_corners of road 1 (a) is 1; it should be a number from 2 to 5"),
    "corners that wrap around": (
        changed("road_corners", 1, 2**62, np.int64),
        "road_corners of road 2 (b) is 4.61169e+18; it should be a number from 2 to 5",
    ),
    "too few corners": (changed("road_corners", 1, 2), "road_corners has a sum of 4, but road_shape has 5 corners"),
    "no lane": (changed("road_lanes", 1, 0), "road_lanes of road 2 (b) is 0; it should be a number from 1 to 100"),
    "weights of text": (
        {"weight": np.array(["1", "0", "0"])},
        "weight is of type <U1; it should be float32 or float64",
    ),
    "weights of truth values": ({"weight": np.array([True, False, False])}, "weight is of type bool"),
    "complex weights": (
        {"weight": np.zeros(3, complex)},
        "array 'weight' is of type complex128; numbers, truth values",
    ),
    "foreign order of bytes": (
        {"weight": np.zeros(3, ">f4")},
        "weight is of type >f4; it should be float32 or float64",
    ),
    "half precision": ({"position": np.zeros((3, 2), np.float16)}, "position is of type float16"),
    "corners that are not whole": ({"road_corners": np.array([2.0, 3.0])}, "road_corners is of type float64"),
    "one device fewer": (
        {"weight": np.zeros(2, np.float32)},
        "weight has the shape (2,); for 3 devices, 2 roads and 2 windows it should be (3,)",
    ),
    "positions in space": ({"position": np.zeros((3, 3), np.float32)}, "position has the shape (3, 3)"),
    "a weight alone": ({"window_weight": np.float32(1)}, "window_weight has the shape (); for 3 devices"),
    "no window": (
        {"window_weight": np.zeros((0, 3), np.float32), "road_density": np.zeros((0, 2), np.float32)},
        "window_weight has 0 windows; it should have 1 to 1000",
    ),
    "windows of roads": ({"road_density": np.zeros((3, 2), np.float32)}, "road_density has the shape (3, 2)"),
}

BAD_FACTS = {
    "missing": ({"names": None}, "meta.names is missing"),
    "unknown": ({"colour": "red"}, "meta.colour is not a setting"),
    "names of numbers": ({"names": ["a", 2, "c"]}, "meta.names: item 2 is 2; it should be text"),
    "empty name": ({"names": ["a", "", "c"]}, "meta.names: item 2 is ''; it should have at least 1 character"),
    "same name twice": ({"names": ["a", "b", "a"]}, "meta.names has 'a' twice; they must differ"),
    "name that a terminal obeys": (
        {"names": ["a", "\x1b[2J", "c"]},
        r"meta.names: item 2 is '\x1b[2J'; it should be one line of characters that can be printed",
    ),
    "too few names": ({"names": ["a", "b"]}, "position has the shape (3, 2); for 2 devices"),
    "one name": ({"names": ["a"]}, "meta.names is ('a',); it should have at least 2 items, not 1"),
    "same road twice": ({"roads": ["a", "a"]}, "meta.roads has 'a' twice; they must differ"),
    "description of two lines": ({"description": "a\nb"}, "meta.description is 'a\\nb'; it should be one line"),
    "string windows": ({"mean_windows": ["0", "2"]}, "meta.mean_windows: item 1 is '0'; it should be a whole number"),
    "windows that are not whole": ({"mean_windows": [0.0, 2.0]}, "meta.mean_windows: item 1 is 0.0; it should be a"),
    "windows of truth": (
        {"mean_windows": [False, True]},
        "meta.mean_windows: item 1 is False; it should be a whole number",
    ),
    "negative window": ({"mean_windows": [-1, 2]}, "meta.mean_windows: item 1 is -1; it should be greater than or"),
    "no window": ({"mean_windows": [1, 1]}, "meta.mean_windows is [1, 1]; give the first window and one past the last"),
    "windows after the end": (
        {"mean_windows": [0, 3], "mean_s": [0.0, 1800.0]},
        "meta.mean_windows ends at 3; there are 2 windows",
    ),
    "seconds that are no windows": (
        {"mean_s": [0.0, 60.0]},
        "meta.mean_s is [0.0, 60.0]; windows 0 to 2 of 600 s are [0, 1200]",
    ),
    "string window": ({"window_s": "600"}, "meta.window_s is '600'; it should be a number"),
    "no length of a window": ({"window_s": 0.0}, "meta.window_s is 0.0; it should be greater than 0"),
    "endless window": ({"window_s": 1e300}, "meta.window_s is 1e+300; it should be less than or equal to 10000000"),
    "negative radius": ({"radius_m": -1.0}, "meta.radius_m is -1.0; it should be greater than 0"),
    "counts of other seeds": ({"teleports": [1]}, "meta.teleports has 1 numbers; there are 2 seeds"),
    "negative count": ({"loaded": [10, -1]}, "meta.loaded: item 2 is -1; it should be greater than or equal to 0"),
    "warnings of numbers": ({"warnings": [1]}, "meta.warnings: item 1 is 1; it should be text"),
    "hash": ({"network_sha256": "0" * 63}, "meta.network_sha256 is"),
    "settings": ({"settings": []}, "meta.settings is []; it should be a table"),
    "place": ({"place": 7}, "meta.place is 7; it should be text"),
}


def refused(path):
    """Return the line with which a file is refused, without the file."""
    with pytest.raises(TrafficError) as caught:
        load_evacuation(path)
    line = str(caught.value)
    assert "\n" not in line
    assert len(line) <= 400
    assert line.startswith(f"{path}: ")
    return line.removeprefix(f"{path}: ").removeprefix("cannot be read: ")


@pytest.mark.parametrize(("arrays", "line"), BAD_ARRAYS.values(), ids=BAD_ARRAYS)
def test_arrays_that_no_evacuation_has_are_refused_by_name(tmp_path, monkeypatch, arrays, line):
    monkeypatch.chdir(tmp_path)  # short messages
    assert refused(write(tmp_path / "e.npz", **arrays)).startswith(line)


@pytest.mark.parametrize(("meta", "line"), BAD_FACTS.values(), ids=BAD_FACTS)
def test_facts_that_no_evacuation_has_are_refused_by_name(tmp_path, meta, line):
    assert refused(write(tmp_path / "e.npz", meta)).startswith(line)


@pytest.mark.parametrize("meta", [None, 7, "text", [1], {}])
def test_facts_that_are_no_table_are_refused(tmp_path, meta):
    contents = {field.name: getattr(evacuation(), field.name) for field in fields(Evacuation) if field.name != "meta"}
    write_checked(tmp_path / "e.npz", 1, {"meta": meta}, contents)
    assert refused(tmp_path / "e.npz").startswith("meta")


def test_every_fact_is_checked(tmp_path):
    for name in evacuation().meta:
        for value in (object, ["\x00"], "\x1b[2J", -1.5, True, {"a": [1, {"b": None}]}):
            if name == "command" and isinstance(value, str):  # as it was typed; it is printed as JSON alone
                continue
            if name == "settings" and isinstance(value, dict):
                continue
            if value is object:
                value = None
            assert f"meta.{name}" in refused(write(tmp_path / "e.npz", {name: value}))


def test_what_would_be_refused_is_not_written(tmp_path):
    bad = replace(evacuation(), weight=np.array([1, np.nan, 0], np.float32))
    with pytest.raises(TrafficError, match=r"e.npz: weight of device 2 \(site 2\) is nan"):
        bad.save(tmp_path / "e.npz")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["e\0.npz", "n" * 5000, "n" * 300 + ".npz"], ids=["nul", "long", "longer than files"])
def test_names_that_no_file_has_are_one_line(name):
    with pytest.raises(TrafficError) as caught:
        load_evacuation(name)
    assert len(str(caught.value)) <= 400


def test_a_fifo_or_a_device_file_as_an_evacuation_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.npz")
    with within(5):
        assert refused(tmp_path / "pipe.npz") == "is not a regular file"
        assert refused("/dev/zero") == "is not a regular file"


STUDY = 'steps = 400\nplace = "e.npz"\n[params]\nn_devices = 3\n[axes]\ncells = [[2, 1]]\nseeds = 1\n'

COMMANDS = (
    ["traffic", "show", "e.npz"],
    ["traffic", "show", "e.npz", "--figure", "map.png"],
    ["plan", "--place", "e.npz", "--draws", "1", "--width", "2"],
    ["advise", "--place", "e.npz"],
    ["evaluate", "oldest-first", "--place", "e.npz"],
    ["run", "study.toml", "--out", "run"],
)


@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
def test_a_weight_of_1e30_is_one_line_in_every_command(tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "e.npz", **changed("weight", 1, 1e30))
    (tmp_path / "study.toml").write_text(STUDY)
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 2, done.output
    assert done.stderr == "uavmec: e.npz: weight of device 2 (site 2) is 1e+30; it should be a number from 0 to 1\n"
    assert {file.name for file in tmp_path.iterdir()} == {"e.npz", "study.toml"}


def test_all_devices_at_one_point_cannot_be_scaled():
    place = evacuation(span=0.0)
    assert place.region_m() == (1, 1)
    with pytest.raises(TrafficError, match="hamlet: all devices stand at one point; leave out place_scale_m"):
        place.local_position(800.0)

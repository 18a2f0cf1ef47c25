"""Files of places."""

import os
from pathlib import Path

import pytest

from tests.deadlines import within
from uavmec_jax.errors import TrafficError
from uavmec_jax.traffic.place import load_place, make_place, shipped_places
from uavmec_jax.traffic.sites import load_sites

OSM = {"name": "x", "network": {"osm": "extract.osm"}}


def test_shipped_places_have_twelve_named_devices():
    assert shipped_places() == ("albany", "round_lake")
    for name in shipped_places():
        place, folder = load_place(name)
        assert place.name == name
        assert "approximation" in place.description
        assert len(place.device) == 12
        assert (folder / str(place.network.nodes)).is_file()
        assert "approximation" in (folder / str(place.network.edges)).read_text()


def test_defaults_and_overrides():
    place, _ = load_place("albany", {"demand": {"vehicles": 7}, "device": []})
    assert place.demand.vehicles == 7
    assert place.demand.exits["dunn_bridge_east"] == 2.0
    assert place.simulation.windows == (0, 6)
    assert place.simulation.n_windows == 12
    assert place.device == ()


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"network": {}}, "network is unclear; give osm, or net, or all of nodes, edges and types"),
        ({"network": {"osm": "a", "net": "b"}}, "network is unclear"),
        ({"network": {"nodes": "a", "edges": "b"}}, "network is unclear"),
        ({"network": {"net": "a", "bbox": [0, 0, 1, 1]}}, "network.bbox is given without network.osm"),
        (
            {"network": {"osm": "a", "bbox": [1, 0, 0, 1]}},
            "network.bbox is [1.0, 0.0, 0.0, 1.0]; give [west, south, east, north]",
        ),
        ({"network": {"osm": "a", "bbox": [0, 0, 1]}}, "network.bbox"),
        ({"network": {"osm": "a", "sumocfg": "b"}}, "network.sumocfg is not a setting"),
        ({"demand": {"vehicles": 0}}, "demand.vehicles is 0; it should be greater than or equal to 1"),
        ({"demand": {"loading_sigma_s": -5.0}}, "demand.loading_sigma_s is -5.0; it should be greater than 0"),
        ({"demand": {"rerouting": 1.5}}, "demand.rerouting is 1.5; it should be less than or equal to 1"),
        ({"demand": {"exits": {"a": float("inf")}}}, "demand.exits.a is inf; it should be a finite number"),
        ({"demand": {"vehicels": 5}}, "demand.vehicels is not a setting; did you mean 'vehicles'?"),
        ({"simulation": {"seeds": 0}}, "simulation.seeds is 0"),
        ({"simulation": {"window_s": 8000.0}}, "simulation.window_s is 8000; it should be at most duration_s (7200)"),
        ({"simulation": {"window_s": 1.0}}, "simulation.window_s is 1; give at most 1000 windows in 7200 s"),
        ({"simulation": {"mean_s": [7200.0, 9000.0]}}, "simulation.mean_s is [7200.0, 9000.0]; give [from, to]"),
        ({"devices": {"count": 1}}, "devices.count is 1; it should be greater than or equal to 2"),
        ({"device": [{"name": "a", "junction": "j"}]}, "holds 1 [[device]] tables; give 2 to 1000, or none"),
        ({"device": [{"name": "a"}, {"name": "b"}]}, "device 1 (a): place is unclear; give junction, or x_m and y_m"),
        ({"device": [{"name": "a", "junction": "j", "x_m": 1, "y_m": 2}] * 2}, "device 1 (a): place is unclear"),
        (
            {"device": [{"name": "a", "junction": "j"}, {"name": "b", "junction": "j", "x_m": 1}]},
            "device 2 (b): place is",
        ),
        ({"device": [{"name": "a", "junction": "j"}] * 2}, "devices 1 and 2 are both named 'a'; names must differ"),
        (
            {"device": [{"name": "a", "x_m": float("nan"), "y_m": 1.0}]},
            "device 1 (a): x_m is nan; it should be a finite",
        ),
        ({"device": [{"name": "a", "x_m": 1.0, "y_m": 1e300}]}, "device 1 (a): y_m is 1e+300; it should be less than"),
        (
            {"device": [{"name": "a", "lon": 1.0, "y_m": 1.0}]},
            "device 1 (a): gives lon; degrees are not read here, give x_m",
        ),
        ({"device": [{"name": "a\x1b[2J"}]}, r"device 1 (a\x1b[2J): name is 'a\x1b[2J'; it should be one line of"),
        ({"device": [3]}, "device 1 (3): is 3; it should be a table"),
        ({"device": 3}, "device is 3; it should be an array"),
        ({"description": "two\nlines"}, "description is 'two\\nlines'; it should be one line of characters"),
        ({"description": "x" * 1001}, "description is 'xxx"),
        ({"network": {"osm": "a\0b"}}, r"network.osm is 'a\x00b'; it should be a path without NUL characters"),
        ({"network": {"osm": ""}}, "network.osm is ''; it should have at least 1 character"),
        ({"demand": {"vehicles": 10**39}}, "demand.vehicles is 1000"),
        (
            {"demand": {"through_per_hour": 1e7}},
            "demand.through_per_hour is 1e+07; in 2.17 hours that makes 2.17e+07 trips",
        ),
        (
            {"simulation": {"window_s": 1e-310, "duration_s": 1e-310}},
            "simulation.window_s is 1e-310; it should be greater",
        ),
        ({"demand": 3}, "demand is 3; it should be a table"),
        ({"name": "../x"}, "name is '../x'"),
    ],
    ids=lambda value: str(value)[:50] if isinstance(value, dict) else "",
)
def test_bad_settings_are_one_line(change, line):
    with pytest.raises(TrafficError) as caught:
        make_place(OSM | change, "p.toml")
    assert str(caught.value).startswith(f"p.toml: {line}")
    assert "\n" not in str(caught.value)


def test_files_that_are_no_places(tmp_path):
    with pytest.raises(TrafficError, match=r"albania: neither a file nor a shipped place; did you mean 'albany'\?"):
        load_place("albania")
    (tmp_path / "broken.toml").write_text("a = = 1")
    with pytest.raises(TrafficError, match=r"broken.toml: not TOML"):
        load_place(tmp_path / "broken.toml")
    (tmp_path / "latin.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(TrafficError, match=r"latin.toml: cannot be read"):
        load_place(tmp_path / "latin.toml")
    (tmp_path / "empty.toml").write_text("")
    with pytest.raises(TrafficError, match=r"empty.toml: network is missing"):
        load_place(tmp_path / "empty.toml")


HOSTILE = {
    "number of 5,000 digits": (
        "[demand]\nvehicles = " + "9" * 5000,
        "not TOML: a whole number has more than 40 digits",
    ),
    "20,000 nested brackets": (
        "device = " + "[" * 20_000 + "]" * 20_000,
        "is nested too deep; tables and arrays may be",
    ),
    "table in place of a number": (
        "[network]\nosm = 'x'\n[demand.vehicles]\nx = 1",
        "demand.vehicles is {'x': 1}; it should be a whole number",
    ),
    "number in place of a table": ("demand = 3\n[network]\nosm = 'x'", "demand is 3; it should be a table"),
    "NUL in a path": ('[network]\nosm = "a\\u0000b"', r"network.osm is 'a\x00b'; it should be a path without NUL"),
    "infinite": ("[network]\nosm = 'x'\n[simulation]\nduration_s = inf", "simulation.duration_s is inf; it should be"),
}


@pytest.mark.parametrize(("text", "line"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_files_of_places_are_one_line(tmp_path, monkeypatch, text, line):
    monkeypatch.chdir(tmp_path)
    Path("p.toml").write_text(text)
    with within(5), pytest.raises(TrafficError) as caught:
        load_place("p.toml", {"demand": {"through_per_hour": 1.0}})
    assert str(caught.value).startswith(f"p.toml: {line}")
    assert len(str(caught.value)) <= 400


@pytest.mark.parametrize(
    "name", ["p\0.toml", "n" * 5000, "n" * 300 + ".toml"], ids=["nul", "long", "longer than files"]
)
def test_names_that_no_file_has_are_one_line(name):
    with pytest.raises(TrafficError) as caught:
        load_place(name)
    assert len(str(caught.value)) <= 400


def test_a_fifo_or_a_device_file_as_a_place_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.toml")
    with within(5):
        for path in (tmp_path / "pipe.toml", Path("/dev/zero")):
            with pytest.raises(TrafficError, match=f"{path}: cannot be read: is not a regular file"):
                load_place(path)
            with pytest.raises(TrafficError, match=f"{path}: cannot be read: is not a regular file"):
                load_sites(path)

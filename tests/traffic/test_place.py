"""Files of places."""

import pytest

from uavmec_jax.errors import TrafficError
from uavmec_jax.traffic.place import load_place, make_place, shipped_places

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
        ({"device": [{"name": "a"}, {"name": "b"}]}, "device 'a': place is unclear; give junction, or x_m and y_m"),
        ({"device": [{"name": "a", "junction": "j", "x_m": 1, "y_m": 2}] * 2}, "device 'a': place is unclear"),
        ({"device": [{"name": "a", "junction": "j"}] * 2}, "device name 'a' is given twice; names must differ"),
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

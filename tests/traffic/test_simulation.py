"""With SUMO: from maps and networks to evacuations (`pytest -m sumo`, needs the extra `traffic`)."""

import bz2
import gzip
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose, assert_array_equal

from tests.planted import imported_from, plant
from tests.traffic.networks import osm_extract
from tests.traffic.test_workspace import wait_for
from uavmec_jax.cli import main
from uavmec_jax.errors import TrafficError
from uavmec_jax.traffic import network, sumo
from uavmec_jax.traffic.build import build_evacuation
from uavmec_jax.traffic.evacuation import load_evacuation
from uavmec_jax.traffic.network import build_network
from uavmec_jax.traffic.place import load_place, make_place
from uavmec_jax.traffic.workspace import Workspace

pytestmark = pytest.mark.sumo

REAL_EXTRACT = next(Path(__file__).parents[3].glob("*/traffic/bad_hersfeld.osm.xml.gz"), None)
"""An extract of OpenStreetMap, too large to commit, if it lies beside the clone."""

SMALL = {
    "demand": {"vehicles": 150, "loading_sigma_s": 300.0, "through_per_hour": 300.0, "warm_up_s": 120.0},
    "simulation": {"seeds": 2, "duration_s": 1200.0, "window_s": 300.0, "mean_s": [0.0, 900.0]},
    "devices": {"count": 4, "span_m": 600.0, "radius_m": 60.0},
}


@pytest.fixture(autouse=True)
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("extracts")
    (folder / "streets.osm.gz").write_bytes(gzip.compress(osm_extract().encode()))
    (folder / "streets.osm.bz2").write_bytes(bz2.compress(osm_extract().encode()))
    return folder


def build(folder, **changes):
    place = make_place({"name": "streets", "network": {"osm": "streets.osm.gz"}} | SMALL | changes, "streets")
    return build_evacuation(place, folder)


def test_an_extract_becomes_an_evacuation(folder):
    evacuation = build(folder)
    assert evacuation.position.shape == (4, 2)
    assert evacuation.window_weight.shape == (4, 4)
    assert evacuation.weight.max() == 1
    assert (evacuation.density_spread > 0).any()
    assert evacuation.meta["sumo"] == sumo.version()
    assert min(evacuation.meta["loaded"]) >= 150
    assert sum(evacuation.meta["unfinished"]) < 0.1 * sum(evacuation.meta["loaded"])
    names = evacuation.meta["roads"]
    assert len(evacuation.roads) == len(names) == len(evacuation.road_lanes)
    # All vehicles leave by the ramp, so its road is the densest of all.
    assert evacuation.mean_road_density.max() > 3 * np.median(evacuation.mean_road_density)


def test_the_same_place_gives_the_same_bits_and_other_seeds_do_not(folder):
    first, again = build(folder), build(folder)
    assert_array_equal(first.road_density, again.road_density)
    assert_array_equal(first.weight, again.weight)
    other = build(folder, demand=SMALL["demand"] | {"vehicles": 160})
    assert not np.array_equal(first.road_density, other.road_density)


def test_the_mean_over_seeds_is_the_mean_of_the_seeds(folder):
    single = build(folder, simulation=SMALL["simulation"] | {"seeds": 1})
    both = build(folder)
    assert_array_equal(single.density_spread, 0)
    assert not np.array_equal(single.road_density, both.road_density)
    # Vehicle-seconds are conserved: with period means, density x lanes x length x time counts the vehicles on the road.
    assert_allclose(single.road_density.sum(), both.road_density.sum(), rtol=0.3)


def test_a_network_is_built_once_and_cached(folder, monkeypatch):
    source = make_place({"name": "t", "network": {"osm": "streets.osm.bz2"}}, "t").network
    with Workspace() as workspace:
        first = build_network(source, folder, workspace)
        cached = first.file.read_bytes()
    monkeypatch.setattr(network.sumo, "program", lambda name: Path("/nowhere") / name)  # it cannot be built again
    with Workspace() as workspace:
        again = build_network(source, folder, workspace)
        assert again.file.read_bytes() == cached
        assert again.sha256 == first.sha256
        copy = workspace.folder / "copy.net.xml"
        copy.write_bytes(cached)
        given = make_place({"name": "t", "network": {"net": str(copy)}}, "t").network
        assert list(build_network(given, folder, workspace).roads) == list(first.roads)


@pytest.mark.parametrize("name", ["round_lake", "albany"])
def test_shipped_places_are_built_from_their_sources(name):
    place, folder = load_place(name)
    shipped = load_evacuation(name)
    with Workspace() as workspace:
        roads = build_network(place.network, folder, workspace)
    assert roads.sha256 == shipped.meta["network_sha256"]
    assert list(roads.roads) == shipped.meta["roads"]
    junctions = [roads.junctions[site.junction] for site in place.device]
    assert_allclose(junctions, shipped.position)


@pytest.mark.slow
def test_a_shipped_evacuation_is_what_its_command_makes():
    place, folder = load_place("round_lake")
    again, shipped = build_evacuation(place, folder), load_evacuation("round_lake")
    assert_array_equal(again.road_density, shipped.road_density)
    assert_array_equal(again.weight, shipped.weight)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            {"network": {"osm": "streets.osm.gz", "bbox": (10.0, 50.0, 10.1, 50.1)}},
            "bounding box 10,50,10.1,50.1 lies outside",
        ),
        ({"network": {"osm": "streets.osm.gz", "bbox": (9.69, 49.9, 9.7035, 50.1)}}, "has no highway exit"),
        ({"network": {"osm": "none.osm"}}, "none.osm: cannot be read"),
        ({"devices": {"count": 60}}, "60 devices, but "),
        ({"demand": {"exits": {"nowhere": 1.0}}}, "demand.exits has 'nowhere'"),
        (
            {"demand": SMALL["demand"] | {"vehicles": 1, "through_per_hour": 0.0, "loading_sigma_s": 1e6}},
            "demand: no vehicle departs within 1200 s",
        ),
        ({"simulation": SMALL["simulation"] | {"time_limit_s": 0.05}}, "SUMO: did not end within its limit of 0.05 s"),
    ],
    ids=lambda value: value[:24] if isinstance(value, str) else "",
)
def test_bad_places_are_one_line(folder, change, line):
    with pytest.raises(TrafficError) as caught:
        build(folder, **change)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_devices_are_checked_before_anything_is_simulated(folder, monkeypatch):
    monkeypatch.setattr("uavmec_jax.traffic.build.simulate", lambda *_: pytest.fail("simulated"))
    sites = [{"name": "a", "junction": "nowhere"}, {"name": "b", "junction": "nowhere"}]
    for change, line in (({"device": sites}, "junction is 'nowhere'"), ({"devices": {"count": 60}}, "60 devices, but")):
        with pytest.raises(TrafficError, match=line):
            build(folder, **change)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('<net version="1.20"/>', "has no junctions with roads for cars between them"),
        ('<net><edge id="e" from="a" to="b"><lane id="e_0" index="0" speed="9" length="9"/></edge></net>', "can read"),
        ("<osm/>", "begins with <osm>"),
    ],
)
def test_bad_networks_are_one_line(tmp_path, text, line):
    (tmp_path / "x.net.xml").write_text(text)
    done = CliRunner().invoke(
        main, ["traffic", "build", "--net", str(tmp_path / "x.net.xml"), "--out", str(tmp_path / "x.npz")]
    )
    assert done.exit_code == 2
    assert line in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "x.npz").exists()


def test_an_extract_without_roads_is_one_line(tmp_path):
    (tmp_path / "sea.osm").write_text("<osm><node id='1' lat='50' lon='9'/></osm>")
    done = CliRunner().invoke(
        main, ["traffic", "build", "--osm", str(tmp_path / "sea.osm"), "--out", str(tmp_path / "x.npz")]
    )
    assert done.exit_code == 2
    assert done.stderr.endswith("sea.osm: holds no roads and no junctions (1 nodes, 0 ways)\n")
    parks = osm_extract().replace('k="highway"', 'k="leisure"')
    (tmp_path / "park.osm").write_text(parks)
    done = CliRunner().invoke(
        main, ["traffic", "build", "--osm", str(tmp_path / "park.osm"), "--out", str(tmp_path / "x.npz")]
    )
    assert done.exit_code == 2
    assert "park.osm: netconvert: " in done.stderr


def test_planted_modules_do_not_run_in_sumo_and_its_helpers(folder, tmp_path, monkeypatch):
    enter, leave, traces = Workspace.__enter__, Workspace.__exit__, []

    def planted(self):
        enter(self)
        plant(self.folder)  # where SUMO runs
        return self

    def look(self, *error):
        traces.append(imported_from(self.folder))
        leave(self, *error)

    monkeypatch.setattr(Workspace, "__enter__", planted)
    monkeypatch.setattr(Workspace, "__exit__", look)
    monkeypatch.chdir(plant(tmp_path / "here"))
    assert build(folder).meta["seeds"] == 2
    assert traces == [[]]
    assert imported_from(tmp_path / "here") == []


def test_sumos_first_error_is_reported(folder, monkeypatch):
    monkeypatch.setattr(
        "uavmec_jax.traffic.simulation.write_trips", lambda path, *_: path.write_text("<routes><trip") or 1
    )
    with pytest.raises(
        TrafficError, match=r"^SUMO: unexpected end of input In file .*simulation-\d.trips.xml"
    ) as caught:
        build(folder)
    assert "Traceback" not in str(caught.value)


def test_the_command_from_end_to_end(folder, tmp_path):
    def run(*options, **tables):
        settings = [f"{table}.{name}={value}" for table, values in tables.items() for name, value in values.items()]
        options = [*options, *(part for setting in settings for part in ("--set", setting))]
        done = CliRunner().invoke(main, [*command, *options])
        assert done.exit_code == 0, done.output
        return done.stdout

    out = tmp_path / "streets.npz"
    (tmp_path / "Städtchen (1).osm.gz").write_bytes((folder / "streets.osm.gz").read_bytes())
    extract = ["--osm", str(tmp_path / "Städtchen (1).osm.gz"), "--bbox", "9.6,49.9,9.8,50.1"]
    command = ["traffic", "build", *extract, "--seeds", "1", "--out", str(out)]
    simulation = {name: value for name, value in SMALL["simulation"].items() if name != "seeds"}
    stdout = run(demand=SMALL["demand"], simulation=simulation, devices=SMALL["devices"])
    assert "vehicles in all (150 evacuated in each)" in stdout
    data = json.loads(CliRunner().invoke(main, ["traffic", "show", str(out), "--json"]).stdout)
    assert len(data["devices"]) == 4
    assert data["meta"]["settings"]["network"]["bbox"] == [9.6, 49.9, 9.8, 50.1]

    sites = tmp_path / "devices.toml"
    sites.write_text('[[device]]\nname = "a"\nx_m = 0\ny_m = 0\n[[device]]\nname = "b"\nx_m = 200.0\ny_m = 50.0\n')
    run("--devices", str(sites), demand=SMALL["demand"], simulation=simulation, devices={"radius_m": 60.0})
    evacuation = load_evacuation(out)
    assert evacuation.meta["names"] == ["a", "b"]
    assert evacuation.name == "St-dtchen-1"
    assert evacuation.region_m() == (200, 50)


def test_nothing_is_left_behind_when_the_command_is_killed(tmp_path):
    before = set(Path(tempfile.gettempdir()).glob("uavmec-traffic-*"))
    process = subprocess.Popen(
        [sys.executable, "-m", "uavmec_jax", "traffic", "build", "albany", "--out", tmp_path / "a.npz"]
    )

    def simulating():
        return any(list(folder.glob("simulation-*.add.xml")) for folder in new())

    def new():
        return set(Path(tempfile.gettempdir()).glob("uavmec-traffic-*")) - before

    wait_for(simulating, 60)
    time.sleep(1)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    wait_for(lambda: not new())
    assert not (tmp_path / "a.npz").exists()


@pytest.mark.full
@pytest.mark.skipif(REAL_EXTRACT is None, reason="there is no real extract beside the clone")
def test_a_real_extract(tmp_path):
    out = tmp_path / "bad_hersfeld.npz"
    command = [
        "traffic",
        "build",
        "--osm",
        str(REAL_EXTRACT),
        "--bbox",
        "9.68,50.85,9.74,50.885",
        "--vehicles",
        "800",
        "--seeds",
        "2",
    ]
    done = CliRunner().invoke(main, [*command, "--out", str(out)])
    assert done.exit_code == 0, done.output
    evacuation = load_evacuation(out)
    assert evacuation.n_devices == 12
    assert len(evacuation.roads) > 800
    assert evacuation.busy.sum() >= 2

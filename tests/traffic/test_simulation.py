"""With SUMO: from maps and networks to what devices see (`pytest -m sumo`, needs the extra `traffic`)."""

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

from tests.traffic.networks import osm_town
from tests.traffic.test_workspace import wait_for
from uavmec_jax.cli import main
from uavmec_jax.errors import TrafficError
from uavmec_jax.traffic import network, sumo
from uavmec_jax.traffic.build import build_evacuation
from uavmec_jax.traffic.evacuation import load_evacuation
from uavmec_jax.traffic.network import build_network
from uavmec_jax.traffic.place import load_place, make_place
from uavmec_jax.traffic.workspace import Workshop

pytestmark = pytest.mark.sumo

REAL = Path(__file__).parents[3] / "shared" / "traffic" / "bad_hersfeld.osm.xml.gz"
SMALL = {
    "demand": {"vehicles": 150, "loading_sigma_s": 300.0, "through_per_hour": 300.0, "warm_up_s": 120.0},
    "simulation": {"seeds": 2, "duration_s": 1200.0, "window_s": 300.0, "mean_s": [0.0, 900.0]},
    "devices": {"count": 4, "span_m": 600.0, "radius_m": 60.0},
}


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    folder = tmp_path_factory.mktemp("town")
    (folder / "town.osm.gz").write_bytes(gzip.compress(osm_town().encode()))
    (folder / "town.osm.bz2").write_bytes(bz2.compress(osm_town().encode()))
    return folder


def built(town, **changes):
    place = make_place({"name": "town", "network": {"osm": "town.osm.gz"}} | SMALL | changes, "town")
    return build_evacuation(place, town)


def test_an_extract_becomes_an_evacuation(town):
    found = built(town)
    assert found.position.shape == (4, 2)
    assert found.window_weight.shape == (4, 4)
    assert found.weight.max() == 1
    assert (found.density_spread > 0).any()
    assert found.meta["sumo"] == sumo.version()
    assert min(found.meta["loaded"]) >= 150
    assert sum(found.meta["unfinished"]) < 0.1 * sum(found.meta["loaded"])
    names = found.meta["roads"]
    assert len(found.roads) == len(names) == len(found.road_lanes)
    # Everybody leaves by the ramp, so its road is the densest of the town.
    assert found.mean_road_density.max() > 3 * np.median(found.mean_road_density)


def test_the_same_place_gives_the_same_bits_and_other_seeds_do_not(town):
    first, again = built(town), built(town)
    assert_array_equal(first.road_density, again.road_density)
    assert_array_equal(first.weight, again.weight)
    other = built(town, demand=SMALL["demand"] | {"vehicles": 160})
    assert not np.array_equal(first.road_density, other.road_density)


def test_the_mean_over_seeds_is_the_mean_of_the_seeds(town):
    one = built(town, simulation=SMALL["simulation"] | {"seeds": 1})
    both = built(town)
    assert_array_equal(one.density_spread, 0)
    assert not np.array_equal(one.road_density, both.road_density)
    # Vehicle-seconds are conserved: with period means, density x lanes x length x time counts who is on the road.
    assert_allclose(one.road_density.sum(), both.road_density.sum(), rtol=0.3)


def test_a_network_is_built_once_and_kept(town, monkeypatch):
    source = make_place({"name": "t", "network": {"osm": "town.osm.bz2"}}, "t").network
    with Workshop() as workshop:
        first = build_network(source, town, workshop)
        kept = first.file.read_bytes()
    monkeypatch.setattr(network.sumo, "program", lambda name: Path("/nowhere") / name)  # it cannot be built again
    with Workshop() as workshop:
        again = build_network(source, town, workshop)
        assert again.file.read_bytes() == kept
        assert again.sha256 == first.sha256
        own = workshop.folder / "own.net.xml"
        own.write_bytes(kept)
        given = make_place({"name": "t", "network": {"net": str(own)}}, "t").network
        assert list(build_network(given, town, workshop).roads) == list(first.roads)


@pytest.mark.parametrize("name", ["round_lake", "albany"])
def test_shipped_places_are_built_from_their_sources(name):
    place, folder = load_place(name)
    shipped = load_evacuation(name)
    with Workshop() as workshop:
        roads = build_network(place.network, folder, workshop)
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
            {"network": {"osm": "town.osm.gz", "bbox": (10.0, 50.0, 10.1, 50.1)}},
            "bounding box 10,50,10.1,50.1 lies outside",
        ),
        ({"network": {"osm": "town.osm.gz", "bbox": (9.69, 49.9, 9.7035, 50.1)}}, "has no highway exit"),
        ({"network": {"osm": "none.osm"}}, "none.osm: cannot be read"),
        ({"devices": {"count": 60}}, "60 devices, but "),
        ({"demand": {"exits": {"nowhere": 1.0}}}, "demand.exits has 'nowhere'"),
        (
            {"demand": SMALL["demand"] | {"vehicles": 1, "through_per_hour": 0.0, "loading_sigma_s": 1e6}},
            "demand: nobody drives",
        ),
        ({"simulation": SMALL["simulation"] | {"time_limit_s": 0.05}}, "SUMO: did not end within its limit of 0.05 s"),
    ],
    ids=lambda value: value[:24] if isinstance(value, str) else "",
)
def test_bad_places_are_one_line(town, change, line):
    with pytest.raises(TrafficError) as caught:
        built(town, **change)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_devices_are_refused_before_anything_is_simulated(town, monkeypatch):
    monkeypatch.setattr("uavmec_jax.traffic.build.simulate", lambda *_: pytest.fail("it was simulated"))
    sites = [{"name": "a", "junction": "nowhere"}, {"name": "b", "junction": "nowhere"}]
    for change, line in (({"device": sites}, "junction is 'nowhere'"), ({"devices": {"count": 60}}, "60 devices, but")):
        with pytest.raises(TrafficError, match=line):
            built(town, **change)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('<net version="1.20"/>', "has no junctions with roads for cars between them"),
        ('<net><edge id="e" from="a" to="b"><lane id="e_0" index="0" speed="9" length="9"/></edge></net>', "can read"),
        ("<osm/>", "begins with <osm>"),
    ],
)
def test_networks_without_sense_are_one_line(tmp_path, text, line):
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
    parks = osm_town().replace('k="highway"', 'k="leisure"')
    (tmp_path / "park.osm").write_text(parks)
    done = CliRunner().invoke(
        main, ["traffic", "build", "--osm", str(tmp_path / "park.osm"), "--out", str(tmp_path / "x.npz")]
    )
    assert done.exit_code == 2
    assert "park.osm: netconvert: " in done.stderr


def test_sumo_tells_its_own_last_error(town, monkeypatch):
    monkeypatch.setattr(
        "uavmec_jax.traffic.simulation.write_trips", lambda path, *_: path.write_text("<routes><trip") or 1
    )
    with pytest.raises(
        TrafficError, match=r"^SUMO: unexpected end of input In file .*simulation-\d.trips.xml"
    ) as caught:
        built(town)
    assert "Traceback" not in str(caught.value)


def test_the_command_from_end_to_end(town, tmp_path):
    settings = [f"{table}.{name}={value}" for table, own in SMALL.items() for name, value in own.items()]
    options = [word for setting in settings for word in ("--set", setting)]
    out = tmp_path / "town.npz"
    (tmp_path / "Städtchen (1).osm.gz").write_bytes((town / "town.osm.gz").read_bytes())
    command = [
        "traffic",
        "build",
        "--osm",
        str(tmp_path / "Städtchen (1).osm.gz"),
        "--bbox",
        "9.6,49.9,9.8,50.1",
        *options,
    ]
    done = CliRunner().invoke(main, [*command, "--seeds", "1", "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "vehicles in all (150 evacuated in each)" in done.stdout
    told = json.loads(CliRunner().invoke(main, ["traffic", "show", str(out), "--json"]).stdout)
    assert len(told["devices"]) == 4
    (tmp_path / "devices.toml").write_text(
        '[[device]]\nname = "a"\nx_m = 0\ny_m = 0\n[[device]]\nname = "b"\nx_m = 200.0\ny_m = 50.0\n'
    )
    done = CliRunner().invoke(
        main, [*command, "--seeds", "1", "--out", str(out), "--devices", str(tmp_path / "devices.toml")]
    )
    assert done.exit_code == 0, done.output
    assert load_evacuation(out).meta["names"] == ["a", "b"]
    assert load_evacuation(out).name == "St-dtchen-1"
    assert load_evacuation(out).region_m() == (200, 50)
    assert told["meta"]["settings"]["network"]["bbox"] == [9.6, 49.9, 9.8, 50.1]


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


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_file(), reason="the extract of a real town is not part of the project")
def test_a_real_town(tmp_path):
    out = tmp_path / "bad_hersfeld.npz"
    command = [
        "traffic",
        "build",
        "--osm",
        str(REAL),
        "--bbox",
        "9.68,50.85,9.74,50.885",
        "--vehicles",
        "800",
        "--seeds",
        "2",
    ]
    done = CliRunner().invoke(main, [*command, "--out", str(out)])
    assert done.exit_code == 0, done.output
    found = load_evacuation(out)
    assert found.n_devices == 12
    assert len(found.roads) > 800
    assert found.busy.sum() >= 2

"""`uavmec traffic`: its output, and one line for bad input. No test here starts SUMO."""

import json
import os
import subprocess
import sys

import pytest
from click.testing import CliRunner

from tests.deadlines import within
from tests.traffic.networks import osm_extract
from uavmec_jax.cli import main
from uavmec_jax.traffic import sumo


def uavmec(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def test_show():
    data = json.loads(uavmec("traffic", "show", "albany", "--json").stdout)
    assert [device["number"] for device in data["devices"] if device["high_traffic"]] == [1, 2, 3, 12]
    assert data["meta"]["teleports"]
    text = uavmec("traffic", "show", "round_lake").stdout
    assert "hand-made approximation" in text
    assert "simulations; roads" in text


def test_figure(tmp_path):
    done = uavmec("traffic", "show", "albany", "--figure", tmp_path / "map.svg")
    assert done.stdout.endswith(f"File: {tmp_path / 'map.svg'}\n")
    assert (tmp_path / "map.svg").read_text().startswith("<?xml")


@pytest.mark.slow
def test_animation_and_plan_of_a_place(tmp_path):
    done = uavmec("traffic", "show", "albany", "--animation", tmp_path / "a.gif", "--policy", "oldest-first")
    assert done.exit_code == 0, done.output
    assert (tmp_path / "a.gif").stat().st_size > 100_000
    data = json.loads(uavmec("evaluate", "oldest-first", "--place", "albany", "--draws", "2", "--json").stdout)
    assert data["policies"][0]["mean"] > 10
    plan = uavmec("plan", "--place", "albany", "--draws", "1", "--width", "8", "--out", tmp_path / "plan", "--json")
    assert "South Mall Arterial and I-787 exit 3" in plan.stdout


BAD = [
    (["show", "albania"], "albania: neither a file nor a shipped place; did you mean 'albany'?"),
    (["show", "x.osm"], "x.osm: cannot be read: "),
    (["show", "albany", "--figure", "map.bmp"], "map.bmp: ends in '.bmp'; it should end in .png or .svg or .pdf"),
    (["show", "albany", "--animation", "map.mp4"], "map.mp4: ends in '.mp4'; it should end in .gif"),
    (["show", "albany", "--animation", "a.gif", "--powered", "13"], "powered is 13; give 0 to 12"),
    (["show", "albany", "--animation", "a.gif", "--policy", "oldest"], "oldest: neither a file nor a policy by name"),
    (["build"], "give one of PLACE, --osm FILE and --net FILE"),
    (["build", "albany", "--osm", "x.osm"], "give one of PLACE, --osm FILE and --net FILE"),
    (["build", "--net", "x.osm", "--bbox", "1,2,3,4"], "--bbox 1,2,3,4: cuts an OpenStreetMap extract; give --osm too"),
    (["build", "--osm", "x.osm", "--bbox", "1,2,3"], "--bbox 1,2,3: give west,south,east,north in degrees"),
    (["build", "--osm", "x.osm", "--bbox", "3,2,1,4"], "x.osm: network.bbox is [3.0, 2.0, 1.0, 4.0]; give [west"),
    (["build", "--osm", "x.osm", "--out", "x.csv"], "--out x.csv: ends in '.csv'; it should end in .npz"),
    (["build", "--osm", "x.osm", "--out", "no/x.npz"], "--out no/x.npz: no is not a folder that can be written to"),
    (["build", "--osm", "x.osm", "--exit", "a=b"], "--exit a=b: the weight is 'b'; give NAME=WEIGHT"),
    (["build", "--osm", "x.osm", "--exit", "a=-1"], "x.osm: demand.exits.a is -1.0; it should be greater than 0"),
    (["build", "--osm", "x.osm", "--vehicles", "0"], "--vehicles is 0; give a whole number from 1 to 1000000"),
    (["build", "--osm", "x.osm", "--set", "vehicles=3"], "--set vehicles: name a table and a setting, e.g. demand.ve"),
    (["build", "--osm", "x.osm", "--set", "demand.cars=3"], "x.osm: demand.cars is not a setting"),
    (["build", "--osm", "x.osm", "--devices", "empty.toml"], "empty.toml: holds no [[device]] tables"),
    (
        ["build", "albany", "--devices", "cams.toml"],
        "cams.toml: device 1 (north camera): gives lon and lat; degrees are not read here, give x_m and y_m in the "
        "metres of the network, or junction (known: name, junction, x_m, y_m)",
    ),
    (
        ["build", "albany", "--devices", "typo.toml"],
        "typo.toml: device 1 (north camera): junction_id is not a setting; did you mean 'junction'? known: name, junction,",
    ),
    (["build", "albany", "--devices", "other.toml"], "other.toml: demand is not a setting; known: device"),
    (
        ["build", "albany", "--devices", "unclear.toml"],
        "unclear.toml: device 2 (south): place is unclear; give junction",
    ),
    (["build", "albany", "--devices", "one.toml"], "one.toml: holds 1 [[device]] tables; give 2 to 1000, or none"),
    (["build", "albany", "--out", "folder.npz"], "--out folder.npz: is not a regular file, and is not replaced"),
    (["build", "albany", "--out", "n" * 300 + "/x.npz"], "--out is 'nnn"),
    (["build", "--osm", "x.osm", "--devices", "none.toml"], "none.toml: cannot be read: No such file"),
    (["build", "albania"], "albania: neither a file nor a shipped place"),
    (["build", "x.sumocfg"], "x.sumocfg: not TOML"),
    (["build", "--net", "x.sumocfg"], "x.sumocfg: is a SUMO configuration, which is never run; give a SUMO network"),
    (["build", "--osm", "x.sumocfg"], "x.sumocfg: is a SUMO configuration, which is never run; give an OpenStreetMap"),
    (["build", "--osm", "broken.osm"], "broken.osm: is not XML, or is truncated"),
]


NORTH, SOUTH = '[[device]]\nname = "north camera"\n', '[[device]]\nname = "south"\n'
JUNCTION = 'junction = "state_swan"\n'


@pytest.mark.parametrize(
    ("arguments", "line"), BAD, ids=lambda value: " ".join(value) if isinstance(value, list) else ""
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, monkeypatch, arguments, line):
    files = {
        "x.osm": osm_extract(),
        "broken.osm": osm_extract()[:500],
        "empty.toml": "",
        "cams.toml": NORTH + "lon = -73.755\nlat = 42.652\n" + SOUTH + "lon = -73.752\nlat = 42.648\n",
        "typo.toml": '[[device]]\njunction_id = "x"\nname = "north camera"\n' + SOUTH,
        "other.toml": NORTH + JUNCTION + SOUTH + JUNCTION + "[demand]\nvehicles = 3\n",
        "unclear.toml": NORTH + JUNCTION + SOUTH + "x_m = 3.0\n",
        "one.toml": NORTH + JUNCTION,
        "x.sumocfg": "<configuration><output><summary-output value='evil.xml'/></output></configuration>",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "folder.npz").mkdir()
    monkeypatch.chdir(tmp_path)
    done = uavmec("traffic", *arguments)
    assert done.exit_code == 2, done.output
    message = done.stderr.removeprefix("uavmec: ").removeprefix(f"{tmp_path}/")
    assert message.startswith(line)
    assert done.stderr.count("\n") == 1
    assert {file.name for file in tmp_path.iterdir()} == {*files, "folder.npz"}  # nothing was written


@pytest.mark.parametrize("option", ["--osm", "--net", "--devices", "PLACE"])
def test_a_fifo_or_a_device_file_is_refused_at_once(tmp_path, monkeypatch, option):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe.toml")
    for path in ("pipe.toml", "/dev/zero"):
        given = [path] if option == "PLACE" else [option, path] + ["albany"] * (option == "--devices")
        with within(20):  # the imports among them
            done = uavmec("traffic", "build", *given)
        assert done.exit_code == 2, done.output
        assert done.stderr.endswith(f"{path}: cannot be read: is not a regular file\n")
        assert done.stderr.count("\n") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["pipe.toml"]


def test_without_sumo_one_line_says_how_to_get_it(tmp_path, monkeypatch):
    def missing(name):
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(sumo.importlib, "import_module", missing)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.osm").write_text(osm_extract())
    for arguments in (["build", "albany"], ["build", "--osm", "x.osm"]):
        done = uavmec("traffic", *arguments)
        assert done.exit_code == 2
        assert done.stderr.startswith("uavmec: SUMO is not installed (No module named 'sumo'")
        assert "pip install 'uavmec-jax[traffic]'" in done.stderr
        assert done.stderr.count("\n") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["x.osm"]


def test_help_needs_neither_jax_nor_sumo():
    code = "import sys; from uavmec_jax.cli import main; main(['traffic', 'build', '--help'], standalone_mode=False); "
    code += "assert not {'jax', 'libsumo', 'numpy'} & set(sys.modules), sorted(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--osm" in done.stdout

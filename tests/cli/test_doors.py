"""What commands meet in their working folder and in the folders that they write: strangers' code, and each other."""

import json
import subprocess
import sys
import time

import pytest

from tests.planted import imported_from, plant
from tests.runs.processes import TINY, environment
from uavmec_jax.files.output_folders import WORK
from uavmec_jax.runs.results_folder import load_results

DEVICES = """name,x_m,y_m,type,task,capacity_j,power,comms
north,100,100,Firefly,HAAR,60000,no,no
south,{x},300,Firefly,DNN,60000,no,yes
"""

IN_ONE_SECOND = """
import types
from uavmec_jax.cli import common, main
common.time = types.SimpleNamespace(strftime=lambda form: "now")
main()
"""
"""The command, in whose default folders it is always the same time."""


def start(*arguments, cwd):
    """Start a command as the console script `uavmec` does: with no working folder on Python's path."""
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "uavmec_jax", *map(str, arguments)],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
    )


def ended(process, seconds=300):
    """Wait for a command; return its exit code and what it wrote on standard error."""
    _, errors = process.communicate(timeout=seconds)
    return process.returncode, errors


def test_planted_modules_would_run_under_python_m(tmp_path):
    plant(tmp_path)  # the trap works
    subprocess.run([sys.executable, "-m", "shutil"], cwd=tmp_path, capture_output=True, check=False)
    assert imported_from(tmp_path) == ["shutil"]


def test_planted_modules_do_not_run_in_a_command(tmp_path):
    (plant(tmp_path) / "tiny.toml").write_text(TINY)
    assert ended(start("validate", "tiny.toml", cwd=tmp_path)) == (0, "")
    assert imported_from(tmp_path) == []


@pytest.mark.ray
def test_planted_modules_do_not_run_in_the_workers_of_ray(tmp_path):
    (plant(tmp_path) / "tiny.toml").write_text(TINY)
    code, errors = ended(
        start("run", "tiny.toml", "--out", plant(tmp_path / "out") / "run", "--ray", "local", cwd=tmp_path)
    )
    assert imported_from(tmp_path) == imported_from(tmp_path / "out") == []
    assert code == 0, errors
    assert load_results(tmp_path / "out" / "run").run["complete"]


@pytest.mark.slow
def test_two_plans_in_one_second_get_two_whole_folders(tmp_path):
    for name, x in (("a", 60), ("b", 90)):
        (tmp_path / f"{name}.csv").write_text(DEVICES.format(x=x))
    plans = [
        subprocess.Popen(
            [sys.executable, "-P", "-c", IN_ONE_SECOND, "plan", file, "--draws", "1", "--width", "2"],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment(),
        )
        for file in ("a.csv", "b.csv")
    ]
    for plan in plans:
        code, errors = ended(plan)
        assert code == 0, errors
    folders = sorted((tmp_path / "runs").iterdir())
    assert [folder.name for folder in folders] == ["plan-now", "plan-now-2"]
    for folder in folders:
        assert json.loads((folder / "tour.json").read_text())
        assert sorted(file.name for file in folder.iterdir()) == ["scenario.toml", "tour.json", "tour.png"]
    assert len({(folder / "scenario.toml").read_text() for folder in folders}) == 2


@pytest.mark.slow
@pytest.mark.parametrize("second", ["plan", "run", "search"])
def test_a_command_in_the_folder_of_a_run_is_told_who_works_there(tmp_path, second):
    (tmp_path / "tiny.toml").write_text(TINY.replace("steps = 4000", "steps = 4000000"))
    (tmp_path / "space.toml").write_text('study = "tiny.toml"\n[space]\nlearning_rate = { low = 1e-4, high = 1e-2 }\n')
    run = start("run", "tiny.toml", "--out", "x", cwd=tmp_path)
    try:
        while not (tmp_path / "x" / "run_plan.json").exists():
            assert run.poll() is None, run.communicate()
            time.sleep(0.1)
        files = {file: file.stat().st_mtime_ns for file in (tmp_path / "x").iterdir() if file.is_file()}
        arguments = {"plan": ["--draws", 1, "--width", 2], "run": ["tiny.toml"], "search": ["space.toml"]}[second]
        code, errors = ended(start(second, *arguments, "--out", "x", cwd=tmp_path))
        assert code == 2, errors
        if second == "search":
            assert "x: already holds a run; resume it with `uavmec resume`, or give another folder" in errors
        else:
            assert f"uavmec: x: process {run.pid} on " in errors
            assert errors.endswith(" is working in it\n")
        assert files == {file: file.stat().st_mtime_ns for file in files}
    finally:
        run.kill()
        run.communicate()


@pytest.mark.slow
def test_a_refused_plan_leaves_nothing(tmp_path):
    (tmp_path / "a.csv").write_text("name\nno position\n")
    code, errors = ended(start("plan", "a.csv", cwd=tmp_path))
    assert code == 2, errors
    assert [file.name for file in tmp_path.iterdir()] == ["a.csv"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["run_plan.json", "run.json", "search.json", "trials.db", "tour.json"])
def test_a_plan_overwrites_nothing_of_another_kind(tmp_path, kind):
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / kind).write_text("{}")
    code, errors = ended(start("plan", "--out", "x", "--draws", 1, "--width", 2, cwd=tmp_path))
    assert code == 2
    assert errors.startswith("uavmec: x: already holds a ")
    assert errors.endswith("give another folder with --out\n")
    assert [file.name for file in (tmp_path / "x").iterdir()] == [kind]
    assert WORK not in kind

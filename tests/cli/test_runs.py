"""The commands about runs: what they print and what they refuse."""

import json
import signal
import sys

import pytest
from click.testing import CliRunner

from tests.cli.test_advise import HARBOUR
from tests.runs.processes import TINY, plan_in
from uavmec_jax.cli import main
from uavmec_jax.cluster.options import RayOptions
from uavmec_jax.errors import StudyError
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.study import parse_study


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    return plan_in(tmp_path_factory.mktemp("planned"), parse_study(TINY, "tiny"), shard_size=2)


def test_status_of_a_run_that_has_not_been_started(planned):
    output = CliRunner().invoke(main, ["status", str(planned)]).stdout
    assert "not complete, 4 agents" in output
    assert "shards: 2 waiting" in output
    assert "steps: 0 of 16,000 (0%)" in output
    assert f"uavmec resume {planned}" in output
    status = json.loads(CliRunner().invoke(main, ["status", str(planned), "--json"]).stdout)
    assert (status["steps"], status["total_steps"], status["seconds_left"]) == (0, 16_000, None)
    assert status["shards"] == {"waiting": 2, "running": 0, "stopped": 0, "failed": 0, "done": 0}
    assert status["disk_bytes"] > 1000


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_ends_with_the_exit_code_of_its_signal(planned, monkeypatch, number):
    study = parse_study(TINY, "tiny")
    stopped = Results(study, {"complete": False, "agents": 4, "stopped_by": int(number)})
    monkeypatch.setattr("uavmec_jax.runs.run.resume_run", lambda *_, **__: stopped)
    done = CliRunner().invoke(main, ["resume", str(planned)])
    assert done.exit_code == 128 + number
    assert done.stderr == f"interrupted: 0 of 4 agents are finished; resume with: uavmec resume {planned}\n"


def test_simulate():
    options = ["--seeds", "30", "--simulate", "--speed", "100000", "--devices", "2", "--json"]
    estimate = json.loads(CliRunner().invoke(main, ["run", "table5", *options]).stdout)
    assert estimate["training_s"] == pytest.approx(750 * 1_000_000 / 200_000, rel=0.1)
    assert estimate["wall_s"] > estimate["training_s"]
    assert 4 * 2**30 < estimate["memory_bytes"] < 12 * 2**30


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["resume", "."], "uavmec: .: holds no run that can be resumed (run_plan.json is missing)"),
        (["status", "nowhere"], "uavmec: nowhere: holds no run that can be resumed"),
        (["run", "table5", "--ray", "table6"], "uavmec: --ray table6: is not the address of a Ray cluster; give"),
        (["resume", ".", "--retries", "2"], "uavmec: --cpus-per-shard, --gpus-per-shard, --resource, --retries and"),
        (
            ["run", "table5", "--resource", "fast", "--ray"],
            "uavmec: --resource fast: give NAME=VALUE, e.g. --resource bigmem=1",
        ),
        (["resume", ".", "--retries", "3"], "uavmec: --cpus-per-shard, --gpus-per-shard, --resource, --retries and"),
        (
            ["run", "table5", "--resource", "fast=no", "--ray"],
            "uavmec: --resource fast=no: the amount must be a positive",
        ),
        (["run", "table5", "--out", "gopher://x/run"], "uavmec: gopher://x/run: "),
        (
            ["run", "table5", "--simulate"],
            "uavmec: --simulate needs --speed, the training steps per second of one device",
        ),
        (["run", "table5", "--set", "axes.seeds=40_000_000"], "uavmec: table5: 1,000,000,000 agents need 93,132 GiB"),
        (["search", "nowhere"], "uavmec: nowhere: neither a file of a search space nor a shipped one; known: dqn"),
        (["search", "dqn", "--out", "."], "uavmec: .: exists and is not an empty folder; give another one with --out"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, monkeypatch, arguments, line):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.txt").write_text("mine")
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 2, done.output
    assert done.stderr.startswith(line)
    assert done.stderr.count("\n") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.slow
def test_a_tour_and_a_run_refuse_each_others_folders(planned, tmp_path):
    tour = tmp_path / "tour"

    def refused(*arguments):
        done = CliRunner().invoke(main, [str(argument) for argument in arguments])
        assert done.exit_code == 2, done.output
        return done.stderr.removesuffix("\n")

    plan = ["plan", str(HARBOUR), "--draws", "1", "--width", "8", "--out"]
    done = CliRunner().invoke(main, [*plan, str(tour)])
    assert done.exit_code == 0, done.output
    assert {file.name for file in tour.iterdir()} == {"tour.json", "tour.png", "scenario.toml", "tour.geojson"}
    for command in ("resume", "status"):
        assert refused(command, tour) == (
            f"uavmec: {tour}: holds no run that can be resumed (run_plan.json is missing); it holds a tour of "
            "`uavmec plan` (tour.json)"
        )
    assert refused("show", tour) == f"uavmec: {tour}: holds no run; it holds a tour of `uavmec plan` (tour.json)"
    taken = f"uavmec: {tour}: already holds a tour of `uavmec plan`; give another folder with --out"
    assert refused("run", "table5", "--out", tour) == refused(*plan, tour) == taken
    assert refused(*plan, planned) == (
        f"uavmec: {planned}: already holds a run; resume it with `uavmec resume`, or give another folder with --out"
    )


@pytest.mark.parametrize(
    ("module", "arguments", "line"),
    [
        ("optuna", ["search", "dqn", "--out", "s"], "search needs the package optuna, which is not installed"),
        ("ray", ["run", "tiny.toml", "--ray"], "--ray needs the package ray, which is not installed"),
        ("upath", ["run", "tiny.toml", "--out", "s3://x/run"], "s3://x/run: needs a package that is not installed"),
        ("tensorboardX", ["run", "tiny.toml", "--tensorboard"], "--tensorboard needs the package tensorboardX"),
    ],
)
def test_a_missing_extra_is_named(tmp_path, monkeypatch, module, arguments, line):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(TINY)
    monkeypatch.setitem(sys.modules, module, None)
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 2, done.output
    assert line in done.stderr
    assert not list(tmp_path.glob("runs/*"))


@pytest.mark.parametrize("ray", [3, {"address": "host:6379"}, ["host:6379"]])
def test_what_is_no_cluster_is_refused(ray):
    with pytest.raises(StudyError, match=r"ray is .*; give True, an address or um\.RayOptions"):
        RayOptions.of(ray)

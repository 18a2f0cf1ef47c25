"""The commands about runs: what they refuse, and what they say."""

import json

import pytest
from click.testing import CliRunner

from tests.runs.processes import TINY
from uavmec_jax.cli import main
from uavmec_jax.runs.shared_run import prepare_run
from uavmec_jax.studies.study import parse_study


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    directory = tmp_path_factory.mktemp("planned") / "run"
    prepare_run(parse_study(TINY, "tiny"), directory, shard_size=2)
    return directory


def test_status_of_a_run_that_nobody_has_started(planned):
    said = CliRunner().invoke(main, ["status", str(planned)]).stdout
    assert "not complete, 4 agents" in said
    assert "shards: 2 waiting" in said
    assert "steps: 0 of 16,000 (0%)" in said
    assert f"nobody is at work; go on with: uavmec resume {planned}" in said
    told = json.loads(CliRunner().invoke(main, ["status", str(planned), "--json"]).stdout)
    assert (told["steps"], told["total_steps"], told["seconds_left"]) == (0, 16_000, None)
    assert told["disk_bytes"] > 1000


def test_simulate():
    options = ["--seeds", "30", "--simulate", "--speed", "100000", "--devices", "2", "--json"]
    told = json.loads(CliRunner().invoke(main, ["run", "table5", *options]).stdout)
    assert told["training_s"] == pytest.approx(750 * 1_000_000 / 200_000, rel=0.1)
    assert told["wall_s"] > told["training_s"]
    assert 4 * 2**30 < told["memory_bytes"] < 12 * 2**30


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["resume", "."], "uavmec: .: holds no run that can be resumed (plan.json is not there)"),
        (["status", "nowhere"], "uavmec: nowhere: holds no run that can be resumed"),
        (["worker", "."], "uavmec: .: holds no run that can be resumed"),
        (["worker", ".", "--share", "3/2"], "uavmec: --share 3/2: give I/N, e.g. 1/2"),
        (["run", "table5", "--simulate"], "uavmec: --simulate needs --speed"),
        (["run", "table5", "--set", "axes.seeds=40_000_000"], "uavmec: table5: 1,000,000,000 agents need 93,132 GiB"),
        (["search", "nowhere"], "uavmec: nowhere: neither a file of a search space nor a shipped one; known: dqn"),
        (["search", "dqn", "--out", "."], "uavmec: .: is not empty and holds no search"),
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


@pytest.mark.parametrize(
    ("module", "arguments", "line"),
    [
        ("optuna", ["search", "dqn", "--out", "s"], "search needs the package optuna, which is not installed"),
        (
            "submitit",
            ["submit", "tiny.toml", "--jobs", "1"],
            "submit needs the package submitit, which is not installed",
        ),
        ("tensorboardX", ["run", "tiny.toml", "--tensorboard"], "--tensorboard needs the package tensorboardX"),
    ],
)
def test_a_missing_extra_is_named(tmp_path, monkeypatch, module, arguments, line):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(TINY)
    monkeypatch.setitem(__import__("sys").modules, module, None)
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 2, done.output
    assert line in done.stderr
    assert not list(tmp_path.glob("runs/*"))

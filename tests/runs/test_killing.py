"""Runs that are killed, stopped, interrupted, and that run out of disk: they go on and end with the same bits."""

import json
import random
import resource
import signal
import time

import pandas as pd
import pytest
from click.testing import CliRunner

from tests.runs.processes import TINY, bits, events, start, uavmec
from uavmec_jax.cli import main
from uavmec_jax.runs.shared_run import prepare_run
from uavmec_jax.runs.status import run_status
from uavmec_jax.studies.study import load_study

pytestmark = pytest.mark.slow

KILLS = 20

TRAINED_LONG = ["--set", "steps=60000", "--shard-size", "2", "--checkpoint-every", "0"]
"""Two shards of a second or two, with checkpoints as often as they are cheap."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("killing")
    (folder / "tiny.toml").write_text(TINY)
    uavmec("run", "tiny.toml", *TRAINED_LONG, "--out", "whole", cwd=folder)
    return folder


def test_the_uninterrupted_run_takes_snapshots_and_tidies_up(folder):
    run = json.loads((folder / "whole" / "run.json").read_text())
    assert run["seconds"]["checkpoint"] > 0
    assert len(events(folder / "whole", "checkpoint")) >= 2
    assert not (folder / "whole" / "shards").exists()


def test_killed_twenty_times_it_ends_with_the_same_bits(folder):
    """SIGKILL at random opt_state: while it starts, trains, writes a checkpoint, judges, puts the results together."""
    chance = random.Random(5)
    kills, runs, restored = 0, 0, 0
    while kills < KILLS:
        runs += 1
        out = folder / f"killed-{runs}"
        arguments = ["run", "tiny.toml", *TRAINED_LONG, "--checkpoint-share", "0.5", "--out", out.name]
        while True:
            process = start(*arguments, cwd=folder)
            if kills < KILLS:
                wait_for_a_moment(chance, process, out)
                if process.poll() is None:
                    process.kill()
                    kills += 1
            _, errors = process.communicate(timeout=120)
            if (out / "plan.json").exists():
                arguments = ["resume", out.name]
            if process.returncode != -signal.SIGKILL:
                assert process.returncode == 0, errors
                break
        assert bits(out) == bits(folder / "whole"), f"after {kills} kills"
        assert not (out / "shards").exists()
        restored += len(events(out, "restored"))
    assert restored >= 2


def wait_for_a_moment(chance, process, out):
    """One while it starts, or one of its work, which is found by what the run tells: machines differ in speed."""
    if chance.random() < 0.6:
        time.sleep(chance.uniform(0.0, 2.0))
        return
    told = lines_told(out) + chance.randint(1, 300)
    while lines_told(out) < told and process.poll() is None:
        time.sleep(0.01)
    if chance.random() < 0.3:
        time.sleep(chance.uniform(0.0, 4.0))


def lines_told(out):
    return sum(file.read_bytes().count(b"\n") for file in (out / "log").glob("*.jsonl"))


def test_told_to_stop_it_keeps_all_and_says_how_to_go_on(folder):
    process = start("run", "tiny.toml", *TRAINED_LONG, "--checkpoint-every", "3600", "--out", "told", cwd=folder)
    wait_for(lambda: len(events(folder / "told", "chunk")) > 20, process)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 143
    assert "go on with: uavmec resume told" in errors
    (kept,) = events(folder / "told", "checkpoint")
    assert events(folder / "told", "chunk")[-1]["steps"] == kept["steps"]
    uavmec("resume", "told", cwd=folder)
    (restored,) = events(folder / "told", "restored")
    assert restored["steps"] == kept["steps"]
    assert bits(folder / "told") == bits(folder / "whole")


def test_a_workers_shard_is_finished_by_another(folder):
    """Two workers with one core each, on a run planned for two: the same bits as on both cores in one process."""
    prepare_run(load_study(folder / "tiny.toml", {"steps": 60_000}), folder / "team", shard_size=2)
    team = [start("worker", "team", "--share", f"{k}/2", cwd=folder) for k in (1, 2)]
    wait_for(lambda: len(events(folder / "team", "chunk")) > 40, team[0])
    wait_for(lambda: len(events(folder / "team", "claimed")) == 2, team[1])
    victim = team[0]
    victim.kill()
    victim.communicate()
    output, errors = team[1].communicate(timeout=120)
    assert team[1].returncode == 0, errors
    assert "complete" in output
    claims = events(folder / "team", "claimed")
    assert [told["taken_over"] for told in claims].count(True) == 1
    assert sorted(told["shard"] for told in events(folder / "team", "done")) == [0, 1]
    assert bits(folder / "team") == bits(folder / "whole")


def test_workers_of_one_command(folder):
    process = start("run", "tiny.toml", *TRAINED_LONG, "--workers", "2", "--out", "two", cwd=folder)
    wait_for(lambda: len(events(folder / "two", "claimed")) == 2, process)
    told = json.loads(CliRunner().invoke(main, ["status", str(folder / "two"), "--json"]).stdout)
    assert told["shards"]["running"] == 2
    assert len(told["workers"]) == 2
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 143, errors
    said = CliRunner().invoke(main, ["status", str(folder / "two")]).stdout
    assert "2 stopped" in said
    assert "nobody is at work; go on with: uavmec resume" in said


def test_workers_of_a_cluster(folder):
    """submitit's executor for this machine stands in for SLURM's."""
    options = ["--jobs", "2", "--executor", "local", "--set", "steps=4000", "--with", "timeout_min=5"]
    said = uavmec("submit", "tiny.toml", *options, "--out", "jobs", cwd=folder).stdout
    assert "2 workers submitted" in said
    deadline = time.monotonic() + 120
    while not run_status(folder / "jobs").complete:
        assert time.monotonic() < deadline
        time.sleep(0.5)
    assert len(pd.read_csv(folder / "jobs" / "agents.csv")) == 4
    wrong = uavmec("submit", "tiny.toml", "--jobs", "1", "--executor", "slum", cwd=folder, check=False)
    assert (wrong.returncode, wrong.stderr.count("\n")) == (2, 1)
    assert "--executor slum" in wrong.stderr


def test_a_full_disk_is_said_and_the_snapshot_before_is_used(folder):
    """A limit on the size of files stands in for it: the log and small files fit, a checkpoint does not."""
    out = "full"
    often = ["--checkpoint-share", "0.5"]
    process = start("run", "tiny.toml", *TRAINED_LONG, *often, "--out", out, cwd=folder)
    wait_for(lambda: len(events(folder / out, "checkpoint")) > 1, process)
    size = events(folder / out, "checkpoint")[0]["bytes"]
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (size // 2, size // 2))
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "File too large" in errors
    assert "uavmec resume full" in errors
    names = {file.name for file in (folder / out / "shards" / "00000").iterdir()}
    assert not any(".part" in name for name in names)
    uavmec("resume", out, cwd=folder)
    assert events(folder / out, "restored")
    assert bits(folder / out) == bits(folder / "whole")


def wait_for(condition, process, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "took too long"
        time.sleep(0.05)

"""Runs that are killed, stopped, or run out of disk space: resumed, they end with the same bits."""

import json
import random
import re
import resource
import signal
import time

import pytest

from tests.runs.processes import TINY, bits, events, start, uavmec

pytestmark = pytest.mark.slow

TRAINED_LONG = ["--set", "steps=60000", "--shard-size", "2", "--checkpoint-every", "0"]
"""Two shards of a second or two, with checkpoints as often as they are cheap."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("killing")
    (folder / "tiny.toml").write_text(TINY)
    uavmec("run", "tiny.toml", *TRAINED_LONG, "--out", "whole", cwd=folder)
    return folder


def test_an_uninterrupted_run_writes_checkpoints_and_removes_them(folder):
    run = json.loads((folder / "whole" / "run.json").read_text())
    assert run["seconds"]["checkpoint"] > 0
    assert len(events(folder / "whole", "checkpoint")) >= 2
    assert not (folder / "whole" / "shards").exists()


@pytest.mark.parametrize("target", [5, pytest.param(20, marks=pytest.mark.full)])
def test_killed_at_random_moments_it_ends_with_the_same_bits(folder, target):
    """SIGKILL while it starts, trains, writes a checkpoint, evaluates, assembles the results."""
    chance = random.Random(5)
    kills, runs, restored = 0, 0, 0
    while kills < target:
        runs += 1
        out = folder / f"killed-{target}-{runs}"
        arguments = ["run", "tiny.toml", *TRAINED_LONG, "--checkpoint-share", "0.5", "--out", out.name]
        while True:
            process = start(*arguments, cwd=folder)
            if kills < target:
                wait_for_a_moment(chance, process, out)
                if process.poll() is None:
                    process.kill()
                    kills += 1
            _, errors = process.communicate(timeout=120)
            if (out / "run_plan.json").exists():
                arguments = ["resume", out.name]
            if process.returncode != -signal.SIGKILL:
                assert process.returncode == 0, errors
                break
        assert bits(out) == bits(folder / "whole"), f"after {kills} kills"
        assert not (out / "shards").exists()
        restored += len(events(out, "restored"))
    assert restored >= max(1, target // 10)


def wait_for_a_moment(chance, process, out):
    """Wait for a random time, or for a random number of events: machines differ in speed."""
    if chance.random() < 0.6:
        time.sleep(chance.uniform(0.0, 2.0))
        return
    target = logged_lines(out) + chance.randint(1, 300)
    while logged_lines(out) < target and process.poll() is None:
        time.sleep(0.01)
    if chance.random() < 0.3:
        time.sleep(chance.uniform(0.0, 4.0))


def logged_lines(out):
    return sum(file.read_bytes().count(b"\n") for file in (out / "log").glob("*.jsonl"))


def test_sigterm_writes_a_checkpoint_and_says_how_to_resume(folder):
    process = start("run", "tiny.toml", *TRAINED_LONG, "--checkpoint-every", "3600", "--out", "ended", cwd=folder)
    wait_for(lambda: len(events(folder / "ended", "chunk")) > 20, process)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 143
    assert "interrupted: 0 of 4 agents are finished; resume with: uavmec resume ended" in errors
    (checkpoint,) = events(folder / "ended", "checkpoint")
    assert re.fullmatch(r"checkpoint-\d{6}-01-[0-9a-f]{6}.npz", checkpoint["file"])
    assert events(folder / "ended", "chunk")[-1]["steps"] == checkpoint["steps"]
    uavmec("resume", "ended", cwd=folder)
    (restored,) = events(folder / "ended", "restored")
    assert restored["steps"] == checkpoint["steps"]
    assert bits(folder / "ended") == bits(folder / "whole")


def test_a_full_disk_is_reported_and_the_checkpoint_before_is_used(folder):
    """A limit on the size of files stands in for a full disk: the log and small files fit, a checkpoint does not."""
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

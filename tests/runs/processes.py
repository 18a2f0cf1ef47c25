"""Small studies, and runs of them in processes of their own."""

import json
import os
import subprocess
import sys
from pathlib import Path

from uavmec_jax.runs.folder import RunFolder
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.run_plan import label_of, plan_run

FINAL = ("agents.csv", "curves.npz", "evaluation.npz", "weights.npz", "study.toml")
"""Files that are the same to the bit, however often a run was stopped."""

TINY = """
name = "tiny"
algorithm = "a2c"
reward = "U"
steps = 4000
[axes]
powered = [12, 4]
connected = [8]
seeds = 2
[evaluation]
draws = 3
validate_every = 500
validation_draws = 2
planners = []
baselines = ["oldest-first"]
"""


UNTRAINED = """
name = "untrained"
algorithm = "none"
[axes]
powered = [12, 4]
connected = [8]
seeds = 2
[evaluation]
draws = 2
planners = []
baselines = ["oldest-first"]
"""
"""A study of which a run takes a second."""


def plan_in(directory, study, shard_size=None) -> Path:
    """Plan a run in a folder, and run nothing."""
    directory.mkdir(parents=True, exist_ok=True)
    plan = plan_run(study, shard_size=shard_size)
    RunFolder.create(directory, study, plan, RunOptions(), label_of(study, plan, "x"))
    return directory


class CtrlC(KeyboardInterrupt):
    """The user presses Ctrl-C."""


def stop_after(chunks):
    """Return an ``on_progress`` that interrupts the run after so many chunks."""
    calls = []

    def on_progress(progress):
        calls.append(progress)
        if len(calls) == chunks:
            raise CtrlC

    return on_progress


def command(*arguments) -> list[str]:
    return [sys.executable, "-m", "uavmec_jax", *map(str, arguments)]


def uavmec(*arguments, cwd, check=True, **options) -> subprocess.CompletedProcess:
    done = subprocess.run(
        command(*arguments), cwd=cwd, capture_output=True, text=True, timeout=300, env=environment(), **options
    )
    assert not check or done.returncode == 0, done.stderr + done.stdout
    return done


def start(*arguments, cwd) -> subprocess.Popen:
    return subprocess.Popen(
        command(*arguments), cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
    )


def environment() -> dict[str, str]:
    root = str(Path(__file__).parents[2])
    return os.environ | {"PYTHONPATH": root, "COLUMNS": "200"}


def bits(directory: Path) -> dict[str, bytes]:
    """The final files of a run; those of training only where something is trained."""
    trained = (directory / "weights.npz").exists()
    names = FINAL if trained else ("agents.csv", "evaluation.npz", "study.toml")
    return {name: (directory / name).read_bytes() for name in names}


def events(directory: Path, kind: str) -> list[dict]:
    """The events of one kind that the processes of a run have logged."""
    lines = [line for file in sorted((directory / "log").glob("*.jsonl")) for line in file.read_text().splitlines()]
    return [event for event in map(json.loads, lines) if event["event"] == kind]

"""The status of a run, read from its files alone."""

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from uavmec_jax.files.leases import describe_holder
from uavmec_jax.runs.folder import RunFolder


@dataclass(frozen=True)
class Status:
    """The status of a run.

    Attributes:
        directory: folder of the run.
        complete: whether the results have been assembled.
        agents: number of agents.
        shards: state -> number of shards: ``waiting``, ``running``, ``stopped``, ``failed``, ``done``.
        steps: environment steps so far (scenarios, where nothing is trained).
        total_steps: environment steps of the whole run.
        steps_per_second: training speed of all workers together; 0 if no shard is running.
        seconds_left: time left for training at that speed; ``None`` if no shard is running.
        disk_bytes: size of the folder.
        workers: the running shards, and the process that works on each.
        failures: shard -> why it failed.
    """

    directory: str
    complete: bool
    agents: int
    shards: dict[str, int]
    steps: int
    total_steps: int
    steps_per_second: float
    seconds_left: float | None
    disk_bytes: int
    workers: list[str]
    failures: dict[int, str]

    def as_json(self) -> dict[str, Any]:
        """Return the status as plain data."""
        return asdict(self)


def run_status(directory: str | Path) -> Status:
    """Return the status of the run in a folder.

    Raises:
        StudyError: the folder holds no run, or the run plan is damaged.
    """
    folder = RunFolder.open(Path(directory))
    plan = folder.plan
    counts: Counter[str] = Counter(waiting=0, running=0, stopped=0, failed=0, done=0)
    steps, speed = 0, 0.0
    workers, failures = [], {}
    for shard, state, facts in folder.states():
        counts[state] += 1
        if state == "done":
            steps += plan.work_of(shard)
        elif state == "failed":
            failures[shard.number] = str(facts.get("error", "an unknown error"))
        else:
            steps += int(facts.get("steps", 0))
        if state == "running":
            speed += float(facts.get("speed", 0.0))
            workers.append(f"shard {shard.number}: {describe_holder(facts)}")
    files = (file for file in folder.path.rglob("*") if file.is_file())
    return Status(
        directory=str(directory),
        complete=folder.complete,
        agents=plan.agents,
        shards=dict(counts),
        steps=steps,
        total_steps=plan.work,
        steps_per_second=speed,
        seconds_left=(plan.work - steps) / speed if speed else None,
        disk_bytes=sum(_size(file) for file in files),
        workers=workers,
        failures=failures,
    )


def _size(file: Path) -> int:
    """Return the size of a file, 0 if it has just been removed."""
    try:
        return file.stat().st_size
    except OSError:
        return 0

"""Where a run stands, from its files alone."""

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from uavmec_jax.files.leases import describe_holder
from uavmec_jax.runs.folder import RunFolder


@dataclass(frozen=True)
class Status:
    """A look at a run.

    Attributes:
        directory: of the run.
        complete: whether the results have been put together.
        agents: in all.
        shards: state -> how many shards are in it: ``waiting``, ``running``, ``stopped``, ``failed``, ``done``.
        steps, total_steps: environment steps made and wanted (scenarios, where nothing is trained).
        steps_per_second: of all workers together; 0 if nobody trains.
        seconds_left: at that speed, of training; ``None`` if nobody trains.
        disk_bytes: of the folder.
        workers: who is at work, and on what.
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
        """Plain values."""
        return asdict(self)


def run_status(directory: str | Path) -> Status:
    """Where a run stands.

    Raises:
        StudyError: the folder holds no run, or its plan is damaged.
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
    """Bytes of a file, 0 if it has just gone."""
    try:
        return file.stat().st_size
    except OSError:
        return 0

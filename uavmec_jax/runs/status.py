"""The status of a run: shards, nodes, progress, speed, retries and time left, from its folder alone."""

from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from uavmec_jax.files.locations import file_system, is_local, path_in_store, reached
from uavmec_jax.files.locks import describe_process, owner_of
from uavmec_jax.runs.folder import RunFolder


@dataclass(frozen=True)
class Status:
    """The status of a run.

    Attributes:
        directory: folder of the run.
        complete: whether the results have been assembled.
        owner: the process that carries the run out, in words; empty if there is none.
        agents: number of agents.
        shards: state -> number of shards: ``waiting``, ``running``, ``stopped``, ``failed``, ``done``.
        nodes: node -> number of shards that run there.
        retries: attempts at shards beyond the first of each.
        steps: environment steps so far (scenarios, where nothing is trained).
        total_steps: environment steps of the whole run.
        steps_per_second: training speed of all running shards together; 0 if there are none.
        seconds_left: time left for training at that speed; ``None`` if no shard is running.
        disk_bytes: size of the folder.
        running: the running shards, and the process that works on each.
        failures: shard -> why it failed.
    """

    directory: str
    complete: bool
    owner: str
    agents: int
    shards: dict[str, int]
    nodes: dict[str, int]
    retries: int
    steps: int
    total_steps: int
    steps_per_second: float
    seconds_left: float | None
    disk_bytes: int
    running: list[str]
    failures: dict[int, str]

    def as_json(self) -> dict[str, Any]:
        """Return the status as plain data."""
        return asdict(self)


@dataclass
class Tally:
    """The states of all shards of a run, added up.

    Attributes:
        shards: state -> number of shards.
        nodes: node -> number of shards that run there.
        retries: attempts at shards beyond the first of each.
        steps: work so far, without that of failed shards.
        failed_steps: work that failed shards leave undone.
        speed: training speed of all running shards together, steps per second.
        running: the running shards, and the process that works on each.
        failures: shard -> why it failed.
    """

    shards: Counter[str] = field(default_factory=lambda: Counter(waiting=0, running=0, stopped=0, failed=0, done=0))
    nodes: Counter[str] = field(default_factory=Counter)
    retries: int = 0
    steps: int = 0
    failed_steps: int = 0
    speed: float = 0.0
    running: list[str] = field(default_factory=list)
    failures: dict[int, str] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: RunFolder) -> "Tally":
        """Add up the states of the shards of a run."""
        tally, plan = cls(), folder.plan
        for shard, state, report in folder.states():
            tally.shards[state] += 1
            tally.retries += max(report.get("attempts", 0) - 1, 0)
            if state == "done":
                tally.steps += plan.work_of(shard)
            elif state == "failed":
                tally.failed_steps += plan.work_of(shard)
                tally.failures[shard.number] = str(report.get("error", "an unknown error"))
            else:
                tally.steps += int(report.get("steps", 0))
            if state == "running":
                tally.speed += float(report.get("speed", 0.0))
                node = str(report.get("node", "an unknown node"))
                tally.nodes[node] += 1
                tally.running.append(f"shard {shard.number}: process {report.get('pid', '?')} on {node}")
        return tally


def run_status(directory: str | Path) -> Status:
    """Return the status of the run in a folder.

    Raises:
        StudyError: the folder holds no run, the run plan is damaged, or its object store cannot be reached.
    """
    with reached(directory) as path:
        return _status_of(RunFolder.open(path))


def _status_of(folder: RunFolder) -> Status:
    plan, tally = folder.plan, Tally.of(folder)
    owner = owner_of(folder.shards_folder)
    return Status(
        directory=str(folder.path),
        complete=folder.complete,
        owner=describe_process(owner) if owner else "",
        agents=plan.agents,
        shards=dict(tally.shards),
        nodes=dict(tally.nodes),
        retries=tally.retries,
        steps=tally.steps,
        total_steps=plan.work,
        steps_per_second=tally.speed,
        seconds_left=(plan.work - tally.steps) / tally.speed if tally.speed else None,
        disk_bytes=_size_of(folder.path),
        running=tally.running,
        failures=tally.failures,
    )


def _size_of(folder: Path) -> int:
    """Return the size of all files in a folder."""
    if not is_local(folder):
        return int(file_system(folder).du(path_in_store(folder)))
    return sum(_size(file) for file in folder.rglob("*") if file.is_file())


def _size(file: Path) -> int:
    """Return the size of a file, 0 if it has just been removed."""
    try:
        return file.stat().st_size
    except OSError:
        return 0

"""Carry out the shards of a run on Ray: each attempt at a shard is a task on some node."""

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from uavmec_jax.cluster.connection import Cluster
from uavmec_jax.cluster.tasks import GRACE_S, ClusterLostError, Task, TaskError, TaskRun
from uavmec_jax.cluster.worker import node_name
from uavmec_jax.errors import StudyError, UserError
from uavmec_jax.files.locations import absolute, to_path
from uavmec_jax.runs.attempt import Attempt
from uavmec_jax.runs.file_names import CHECKPOINT, LOG, PROGRESS
from uavmec_jax.runs.folder import RunFolder
from uavmec_jax.runs.in_process import OnProgress, not_written, record_failure
from uavmec_jax.runs.log import RunLog
from uavmec_jax.runs.reports import read_progress
from uavmec_jax.runs.run_plan import Shard
from uavmec_jax.runs.shard_runner import ShardRunner
from uavmec_jax.runs.signals import StopSignal
from uavmec_jax.runs.status import Tally
from uavmec_jax.training.machine import WorkerOptions
from uavmec_jax.training.population import Progress

_POLL_EVERY_S = 1.0
"""Least seconds between two looks at the reports of all attempts."""

_SAVED_PER_SECOND = 30e6
"""Bytes of a checkpoint that shards on slow, shared storage surely write in a second."""

_NODES_SHOWN = 4
"""Nodes that the progress bar names."""

_POLL_SHARE = 0.05
"""Largest share of the driver's time that these looks take."""


def run_on_ray(
    folder: RunFolder,
    cluster: Cluster,
    stop: StopSignal,
    log: RunLog,
    on_progress: OnProgress,
) -> None:
    """Make attempts at every shard that is neither finished nor failed, until it is.

    Raises:
        Interrupted: a signal arrived; the shards in training have checkpoints.
        StudyError: a file could not be written, the nodes have other code, or the connection to the cluster is lost.
    """
    open_shards = {s.number: s for s, state, _ in folder.states() if state not in ("done", "failed")}
    monitor, worker = _ProgressMonitor(folder, on_progress), WorkerOptions.of(cluster)
    attempts: dict[int, str] = {}

    def task_of(shard: Shard) -> Task:
        def arguments() -> tuple[Any, ...]:
            attempts[shard.number] = attempt = folder.new_attempt(shard)
            return absolute(folder.path), folder.fingerprint, shard.number, attempt, worker

        def position() -> list[str]:
            return [file.name for file in folder.files(shard, CHECKPOINT)]

        return Task(shard.number, attempt_shard, arguments, position)

    def on_wait() -> None:
        stop.check()
        monitor.poll()

    def on_event(event: str, *, error: str, task: int | None = None) -> None:
        where = {} if task is None else _where(folder, open_shards[task], attempts[task])
        log.event(event, **where, error=error)

    largest = max((partition.shard_bytes for partition in folder.plan.partitions.values()), default=0)
    run = TaskRun(cluster, on_wait, on_event, grace_s=GRACE_S + largest / _SAVED_PER_SECOND)
    # closing: an error here must cancel the other attempts now, not when its traceback is let go
    with closing(run.results(map(task_of, open_shards.values()))) as outcomes:
        try:
            for number, outcome in outcomes:
                if isinstance(outcome, TaskError):
                    _give_up(folder, open_shards[number], outcome, log)
        except ClusterLostError as error:
            raise StudyError(f"{error}; resume with: uavmec resume {folder.path}") from None
    monitor.poll(last=True)


def _where(folder: RunFolder, shard: Shard, attempt: str) -> dict[str, Any]:
    """Return shard, attempt and node of an attempt, as they stand in the log; the node only if the attempt began there."""
    report = read_progress(folder.shard_folder(shard) / f"{PROGRESS}-{attempt}.json")
    node = {"node": report["node"]} if "node" in report else {}
    return {"shard": shard.number, "attempt": attempt} | node


def _give_up(folder: RunFolder, shard: Shard, failed: TaskError, log: RunLog) -> None:
    """Record that a shard has failed, or end the run if that is not the shard's fault."""
    if isinstance(failed.cause, UserError):
        raise failed.cause
    if isinstance(failed.cause, OSError | MemoryError):
        raise not_written(folder, shard, failed.cause)
    record_failure(folder, shard, failed.error, failed.trace, log)


@dataclass
class _ProgressMonitor:
    """Reports the progress of all attempts, from what they write."""

    folder: RunFolder
    on_progress: Callable[[Progress], None]
    _next: float = field(default_factory=time.monotonic)

    def poll(self, *, last: bool = False) -> None:
        started = time.monotonic()
        if started < self._next and not last:
            return
        tally = Tally.of(self.folder)
        nodes, closed = tally.nodes, tally.shards["done"] + tally.shards["failed"]
        detail = ", ".join(f"{count} on {node}" for node, count in sorted(nodes.items())[:_NODES_SHOWN])
        detail += f" and {len(nodes) - _NODES_SHOWN} more nodes" * (len(nodes) > _NODES_SHOWN)
        detail += f"; {tally.retries} retries" * (tally.retries > 0)
        steps = tally.steps + tally.failed_steps
        self.on_progress(Progress(max(closed - 1, 0), steps, self.folder.plan.work, float("nan"), detail))
        ended = time.monotonic()
        self._next = ended + max(_POLL_EVERY_S, (ended - started) / _POLL_SHARE)


def attempt_shard(directory: str, fingerprint: str, number: int, attempt: str, worker: WorkerOptions) -> None:
    """Make an attempt at a shard; this runs on a node."""
    with worker.prepared():
        folder, runner = _open(directory, fingerprint)
        shard = folder.plan.shards[number]
        if folder.is_closed(shard):  # by an attempt that was believed dead
            return
        context = {"node": node_name(), "attempt": attempt}
        log = RunLog(folder.path / LOG, tensorboard=folder.options.tensorboard, context=context)
        try:
            with StopSignal() as stop:
                Attempt(folder, shard, attempt, runner, stop, log, node=node_name()).run()
        finally:
            log.close()


@lru_cache(maxsize=1)
def _open(directory: str, fingerprint: str) -> tuple[RunFolder, ShardRunner]:
    """Open the run; the programs that are compiled for its first shard serve the others in this process.

    Raises:
        StudyError: the folder holds another run than the driver's, or none: this node does not share it.
    """
    folder = RunFolder.open(to_path(directory))
    if folder.fingerprint != fingerprint:
        raise StudyError(f"{directory}: holds another run here than on the driver's machine; the nodes must share it")
    return folder, ShardRunner(folder.study, folder.plan)

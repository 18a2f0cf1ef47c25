"""Several workers of one run on this machine: one process each, with its share of the cores."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

from uavmec_jax.errors import StudyError
from uavmec_jax.runs.folder import LOG, RunFolder
from uavmec_jax.runs.signals import StopSignal
from uavmec_jax.training.population import Progress

_POLL_S = 0.5
"""Seconds between two checks of the workers."""


def work_together(
    folder: RunFolder,
    workers: int,
    stop: StopSignal,
    on_progress: Callable[[Progress], None],
    log_event: Callable[..., Any],
) -> None:
    """Start workers and wait until all shards are finished or have failed; if a worker dies, the others take over.

    Raises:
        StudyError: all workers died before the end.
        Interrupted: a signal arrived; it was passed on, and the workers have written checkpoints.
    """
    log = folder.path / LOG
    log.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "uavmec_jax", "worker", str(folder.path.absolute()), "--share"]
    with (log / "workers.err").open("a", encoding="utf-8") as errors:
        team = [
            subprocess.Popen([*command, f"{k + 1}/{workers}"], stdout=subprocess.DEVNULL, stderr=errors)
            for k in range(workers)
        ]
        alive = list(team)
        try:
            while alive:
                stop.check()
                time.sleep(_POLL_S)
                on_progress(team_progress(folder))
                for worker in [process for process in alive if process.poll() is not None]:
                    alive.remove(worker)
                    if worker.returncode:
                        log_event("died", pid=worker.pid, exit_code=worker.returncode)
        except KeyboardInterrupt:
            for worker in alive:
                worker.send_signal(signal.SIGTERM)
            raise
        finally:
            for worker in team:
                worker.wait()
    left = [shard for shard, state, _ in folder.states() if state not in ("done", "failed")]
    if left:
        last = (log / "workers.err").read_text(encoding="utf-8").strip().rpartition("\n")[2]
        raise StudyError(
            f"{folder.path}: all {workers} workers died, {len(left)} of {len(folder.plan.shards)} shards are left"
            f"{f'; the last error: {last}' if last else ''}; `uavmec resume {folder.path}` resumes the run"
        )


def team_progress(folder: RunFolder) -> Progress:
    """Return the progress of all workers together, from their leases."""
    plan, steps, closed = folder.plan, 0, 0
    for shard, state, facts in folder.states():
        if state in ("done", "failed"):
            steps += plan.work_of(shard)
            closed += 1
        else:
            steps += int(facts.get("steps", 0))
    return Progress(max(closed - 1, 0), steps, plan.work, float("nan"))

"""Several workers of one run on this machine: processes, each with its share of the cores."""

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

_LOOK_S = 0.5


def work_together(
    folder: RunFolder, workers: int, stop: StopSignal, on_progress: Callable[[Progress], None], tell: Callable[..., Any]
) -> None:
    """Start workers and wait until all shards are over; if one dies, the others take over what it had.

    Raises:
        StudyError: all have died before the work was done.
        Interrupted: a signal came; it was passed on, and the workers have kept what they had.
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
                time.sleep(_LOOK_S)
                on_progress(team_progress(folder))
                for worker in [one for one in alive if one.poll() is not None]:
                    alive.remove(worker)
                    if worker.returncode:
                        tell("died", pid=worker.pid, exit_code=worker.returncode)
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
            f"{f'; the last one said: {last}' if last else ''}; `uavmec resume {folder.path}` goes on"
        )


def team_progress(folder: RunFolder) -> Progress:
    """How far all workers are together, from what they tell with their leases."""
    plan, steps, over = folder.plan, 0, 0
    for shard, state, facts in folder.states():
        if state in ("done", "failed"):
            steps += plan.work_of(shard)
            over += 1
        else:
            steps += int(facts.get("steps", 0))
    return Progress(max(over - 1, 0), steps, plan.work, float("nan"))

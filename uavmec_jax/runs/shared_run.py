"""Runs that are planned by one process and made by workers, on as many machines as share the folder."""

from pathlib import Path

from uavmec_jax.errors import StudyError
from uavmec_jax.files.leases import Leases
from uavmec_jax.runs.folder import SHARDS, RunFolder
from uavmec_jax.runs.label import label_of
from uavmec_jax.runs.log import OnEvent
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.results_folder import (
    assemble_results,
    check_directory,
    check_empty,
    finished_shards,
    worker_hint,
)
from uavmec_jax.runs.run_plan import plan_run
from uavmec_jax.runs.signals import StopSignal
from uavmec_jax.runs.worker import OnProgress, Worker, make_worker
from uavmec_jax.studies.schema import Study


def prepare_run(
    study: Study,
    directory: str | Path,
    *,
    command: str | None = None,
    workers: int = 1,
    shard_size: int | None = None,
    jobs: int = 1,
    options: RunOptions | None = None,
) -> RunFolder:
    """RunPlan a run that workers (:func:`work_on`) then make.

    Args:
        study, directory, command, shard_size, options: see :func:`run_study`.
        workers: processes that share one machine.
        jobs: workers on all machines together.

    Raises:
        StudyError: see :func:`run_study`.
    """
    path, options = Path(directory), options or RunOptions()
    check_directory(path)
    plan = plan_run(study, workers=workers, shard_size=shard_size, jobs=jobs)
    lease = Leases(options.lease_s).hold(path / SHARDS, path, worker_hint(path))
    try:
        check_empty(path)
        return RunFolder.create(path, study, plan, options, label_of(study, plan, command))
    finally:
        lease.release()


def work_on(
    directory: str | Path,
    *,
    wait: bool = True,
    on_progress: OnProgress = lambda _: None,
    on_event: OnEvent = lambda event, facts: None,
) -> bool:
    """Be one more worker of a run, until all of its shards are finished; tells whether they are.

    The last one to finish puts the results together, unless somebody who started the run waits to do it.

    Args:
        directory: of the run, which hosts may share.
        wait: for shards that others hold, to take over if they die.
        on_progress: told after every chunk.
        on_event: told ``(event, facts)`` of everything that is logged.

    Raises:
        StudyError: the directory holds no run, its plan is damaged, it was planned by other code, or has a reward
            function, which only :func:`um.runs.resume_run` can be given.
        Interrupted: a signal came; what this worker had is kept.
    """
    path = Path(directory)
    with StopSignal() as stop:
        worker = make_worker(path, stop=stop, on_progress=on_progress, on_event=on_event)
        worker.folder.check_code()
        worker.folder.check_reward(None)
        try:
            worker.work(wait=wait)
        finally:
            worker.log.close()
        complete = all(state == "done" for _, state, _ in worker.folder.states())
        if complete and not worker.folder.complete:
            _assemble_alone(worker)
    return complete


def _assemble_alone(worker: Worker) -> None:
    """Unless somebody holds the run who does it: the one that started it, or another worker."""
    try:
        lease = worker.leases.hold(worker.folder.shards_folder, worker.folder.path)
    except StudyError:
        return
    try:
        if not worker.folder.complete:
            assemble_results(worker.folder, finished_shards(worker.folder))
    finally:
        lease.release()

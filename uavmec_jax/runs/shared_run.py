"""Runs that one process plans and workers carry out, on any number of machines that share the folder."""

from pathlib import Path

from uavmec_jax.errors import StudyError
from uavmec_jax.files.leases import Leases
from uavmec_jax.runs.folder import SHARDS, RunFolder
from uavmec_jax.runs.log import OnEvent
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.results_folder import (
    assemble_results,
    check_directory,
    check_empty,
    finished_shards,
    worker_hint,
)
from uavmec_jax.runs.run_plan import label_of, plan_run
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
    """Plan a run, which workers (:func:`work_on`) then carry out.

    Args:
        study, directory, command, shard_size, options: see :func:`run_study`.
        workers: processes on each machine.
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
    """Join the workers of a run until no shard is left, and return whether all are finished.

    The last worker assembles the results, unless the process that started the run is waiting to do so.

    Args:
        directory: folder of the run, which hosts may share.
        wait: whether to wait for shards that other workers hold, to take over if those die.
        on_progress: called after every chunk.
        on_event: called with ``(event, facts)`` of everything that is logged.

    Raises:
        StudyError: the directory holds no run, the run plan is damaged, or the run was planned with other code or has a
            reward function, which only :func:`um.runs.resume_run` takes.
        Interrupted: a signal arrived; the shard in training has a checkpoint.
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
    """Assemble the results, unless another process holds the run and will do so."""
    try:
        lease = worker.leases.hold(worker.folder.shards_folder, worker.folder.path)
    except StudyError:
        return
    try:
        if not worker.folder.complete:
            assemble_results(worker.folder, finished_shards(worker.folder))
    finally:
        lease.release()

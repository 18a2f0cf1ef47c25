"""Workers on a cluster, started by submitit; what they do is what `uavmec worker` does."""

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from uavmec_jax.errors import StudyError
from uavmec_jax.training import host


def submit_workers(prepare: Callable[[], Path], jobs: int, executor: str, parameters: Mapping[str, Any]) -> list[str]:
    """Submit workers as one array of jobs, and return their names.

    Args:
        prepare: plans the run and returns its folder; called once submitit is known to take executor and parameters.
        jobs: workers.
        executor: of submitit: ``slurm``, ``local``, ``debug``.
        parameters: for ``AutoExecutor.update_parameters``, e.g. ``timeout_min``, ``cpus_per_task``, ``slurm_partition``.

    Raises:
        StudyError: submitit is not installed, or knows no such executor or parameter.
    """
    submitit = host.optional("submitit", "submit", "cluster")

    def queue(folder: Path) -> Any:
        try:
            made = submitit.AutoExecutor(folder=folder, cluster=executor)
        except (RuntimeError, ValueError) as error:
            raise StudyError(f"--executor {executor}: {error}") from None
        try:
            made.update_parameters(name="uavmec", **parameters)
        except (NameError, TypeError, AssertionError) as error:
            raise StudyError(f"--with: {error}") from None
        return made

    queue(Path(tempfile.gettempdir()))
    directory = prepare()
    jobs_of_run = queue(directory / "log" / "jobs")
    return [job.job_id for job in jobs_of_run.map_array(_work, [str(directory)] * jobs)]


def _work(directory: str) -> bool:
    """What runs on a node: one worker with the cores that the scheduler gave it."""
    host.use_all_cores()
    from uavmec_jax.runs.shared_run import work_on

    return work_on(directory)

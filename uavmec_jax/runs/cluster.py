"""Start workers on a cluster with submitit; each does what `uavmec worker` does."""

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from uavmec_jax.errors import StudyError
from uavmec_jax.training import host


def submit_workers(prepare: Callable[[], Path], jobs: int, executor: str, parameters: Mapping[str, Any]) -> list[str]:
    """Submit workers as one job array, and return the job ids.

    Args:
        prepare: plans the run and returns its folder; called after submitit has accepted executor and parameters.
        jobs: number of workers.
        executor: submitit's: ``slurm``, ``local`` or ``debug``.
        parameters: for ``AutoExecutor.update_parameters``, e.g. ``timeout_min``, ``cpus_per_task``, ``slurm_partition``.

    Raises:
        StudyError: submitit is not installed, or refuses the executor or a parameter.
    """
    submitit = host.optional("submitit", "submit", "cluster")

    def make_executor(folder: Path) -> Any:
        try:
            auto_executor = submitit.AutoExecutor(folder=folder, cluster=executor)
        except (RuntimeError, ValueError) as error:
            raise StudyError(f"--executor {executor}: {error}") from None
        try:
            auto_executor.update_parameters(name="uavmec", **parameters)
        except (NameError, TypeError, AssertionError) as error:
            raise StudyError(f"--with: {error}") from None
        return auto_executor

    make_executor(Path(tempfile.gettempdir()))
    directory = prepare()
    executor_of_run = make_executor(directory / "log" / "jobs")
    return [job.job_id for job in executor_of_run.map_array(_work, [str(directory)] * jobs)]


def _work(directory: str) -> bool:
    """Run one worker on a node, with the cores that the scheduler assigned to it."""
    host.use_all_cores()
    from uavmec_jax.runs.shared_run import work_on

    return work_on(directory)

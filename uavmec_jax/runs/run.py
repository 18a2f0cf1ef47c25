"""Run a study in one process or several, or resume a run, and assemble its results."""

import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from uavmec_jax.errors import StudyError
from uavmec_jax.files.leases import Leases
from uavmec_jax.runs.folder import RUN_PLAN, SHARDS, RunFolder
from uavmec_jax.runs.log import OnEvent, tensorboard_writer
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.results_folder import (
    assemble_results,
    check_directory,
    check_empty,
    load_results,
    partial_results,
    read_finished_shards,
    worker_hint,
)
from uavmec_jax.runs.run_plan import RunPlan, label_of, plan_run
from uavmec_jax.runs.shard_runner import ShardRunner
from uavmec_jax.runs.signals import StopSignal
from uavmec_jax.runs.team import work_together
from uavmec_jax.runs.worker import OnProgress, make_worker
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.shard_result import ShardResult
from uavmec_jax.training.population import Progress

RewardFunction = Callable[[Mapping[str, Any]], Any]


def run_study(
    study: Study,
    directory: str | Path | None = None,
    *,
    reward: RewardFunction | None = None,
    command: str | None = None,
    workers: int = 1,
    shard_size: int | None = None,
    options: RunOptions | None = None,
    on_progress: OnProgress = lambda _: None,
    on_event: OnEvent = lambda event, facts: None,
) -> Results:
    """Train and evaluate the population of a study.

    With a directory, the run can be resumed whatever happens, see :func:`resume_run`. Ctrl-C and SIGTERM end it early: the
    results then hold the finished shards, ``run["complete"]`` is False and ``run["stopped_by"]`` is the signal's number.

    Args:
        study: from :func:`um.load_study`.
        directory: folder of the run; ``None`` saves nothing.
        reward: a function of the reward's terms (see :func:`um.make_reward`) that replaces the study's reward; the run's
            label then names it.
        command: the command line, for the label of the results.
        workers: number of processes; more than one need a directory.
        shard_size: most agents in a shard; by default as many as the devices' caches hold.
        options: how the run is checkpointed and logged.
        on_progress: called after every chunk.
        on_event: called with ``(event, facts)`` of everything that is logged.

    Raises:
        StudyError: the population does not fit in memory, the directory cannot take a run or another process works in it,
            shards failed, ``reward`` is given beside an axis of rewards, or tensorboardX is needed and not installed.
    """
    if reward is not None and "reward" in study.axes:
        raise StudyError(f"{study.name}: axes.reward is given, and a reward function too; leave one of them out")
    if workers > 1 and (directory is None or reward is not None):
        raise StudyError(
            f"{study.name}: workers is {workers}; several processes need a directory and no reward function"
        )
    if directory is not None:
        check_directory(Path(directory))
    plan = plan_run(study, workers=workers, shard_size=shard_size)
    label = label_of(study, plan, command)
    if reward is not None:
        label["reward_function"] = getattr(reward, "__qualname__", repr(reward))
    runner = ShardRunner(study, plan, reward)
    if directory is None:
        return _run_in_memory(study, plan, runner, label, on_progress)
    path, options = Path(directory), options or RunOptions()
    if options.tensorboard:
        tensorboard_writer()
    lease = Leases(options.lease_s).hold(path / SHARDS, path, worker_hint(path))
    try:
        check_empty(path)
        RunFolder.create(path, study, plan, options, label)
        return _run(path, runner, workers, on_progress, on_event)
    finally:
        lease.release()


def resume_run(
    directory: str | Path,
    *,
    reward: RewardFunction | None = None,
    workers: int | None = None,
    other_code: bool = False,
    on_progress: OnProgress = lambda _: None,
    on_event: OnEvent = lambda event, facts: None,
) -> Results:
    """Resume a run that was stopped or killed; its results are those of an uninterrupted run, to the bit.

    Finished shards are kept, the others resume from their last intact checkpoint; failed shards are run again.

    Args:
        directory: folder of the run.
        reward: the reward function that the run was started with, if any.
        workers: number of processes; by default as many as the run was planned for.
        other_code: resume although code or libraries have changed since the run was planned; its label then says so.
        on_progress: called after every chunk.
        on_event: called with ``(event, facts)`` of everything that is logged.

    Raises:
        StudyError: the directory holds no run, the run plan is damaged, another process works in it, or the run needs
            its reward function or was planned with other code.
    """
    path = Path(directory)
    folder = RunFolder.open(path)
    folder.check_reward(reward)
    if folder.complete:
        shutil.rmtree(folder.shards_folder, ignore_errors=True)
        return load_results(path)
    if not other_code:
        folder.check_code()
    lease = Leases(folder.options.lease_s).hold(folder.shards_folder, path, worker_hint(path))
    try:
        for shard in folder.plan.shards:
            folder.failure(shard).unlink(missing_ok=True)
        label = {"other_code": differ} if (differ := folder.other_code()) else {}
        runner = ShardRunner(folder.study, folder.plan, reward)
        return _run(path, runner, workers or folder.plan.workers, on_progress, on_event, label)
    finally:
        lease.release()


def run_or_resume(
    study: Study, directory: str | Path, *, command: str | None = None, on_progress: OnProgress = lambda _: None
) -> Results:
    """Run a study in a folder; if it holds a run, resume that, or load its results if it is complete."""
    if (Path(directory) / RUN_PLAN).exists():
        return resume_run(directory, on_progress=on_progress)
    return run_study(study, directory, command=command, on_progress=on_progress)


def _run(
    path: Path,
    runner: ShardRunner,
    workers: int,
    on_progress: OnProgress,
    on_event: OnEvent,
    label: Mapping[str, Any] = MappingProxyType({}),
) -> Results:
    """Run all shards that are not finished, and assemble the results."""
    with StopSignal() as stop:
        worker = make_worker(path, runner=runner, stop=stop, on_progress=on_progress, on_event=on_event)
        folder = worker.folder
        try:
            while True:
                if workers > 1:
                    work_together(folder, workers, stop, on_progress, worker.log.event)
                else:
                    worker.work()
                finished, damaged = read_finished_shards(folder, worker.log.event)
                if not damaged:
                    break
                worker.reopen(damaged)
        except KeyboardInterrupt as interrupt:
            results = partial_results(folder)
            results.run["stopped_by"] = getattr(interrupt, "signal", 2)
            return results
        finally:
            worker.log.close()
        _check_failures(folder)
        return assemble_results(folder, finished, **label)


def _check_failures(folder: RunFolder) -> None:
    """Raise a StudyError if a shard has failed."""
    failed = [(shard, facts) for shard, state, facts in folder.states() if state == "failed"]
    if failed:
        shard, facts = failed[0]
        raise StudyError(
            f"{folder.path}: {len(failed)} of {len(folder.plan.shards)} shards failed, shard {shard.number} with "
            f"{facts.get('error', 'an unknown error')} ({folder.failure(shard)}); `uavmec resume {folder.path}` runs them "
            "again"
        )


def _run_in_memory(study: Study, plan: RunPlan, runner: ShardRunner, label: dict, on_progress: OnProgress) -> Results:
    """Train and evaluate one shard after the other in this process, and save nothing."""
    finished: list[ShardResult] = []
    done = 0
    interrupted = False
    try:
        for shard in plan.shards:
            started = time.perf_counter()
            training = runner.start(shard)
            if training is not None:
                for _ in training.run():
                    steps = done + shard.agents * training.steps
                    on_progress(Progress(shard.number, steps, plan.work, training.mean_episode_length))
            finished.append(runner.finish(shard, training))
            finished[-1].seconds["wall"] = time.perf_counter() - started
            done += plan.work_of(shard)
            if training is None:
                on_progress(Progress(shard.number, done, plan.work, float("nan")))
    except KeyboardInterrupt:
        interrupted = True
    results = Results.of(study, label, finished, plan.agents)
    if interrupted:
        results.run["stopped_by"] = 2
    return results

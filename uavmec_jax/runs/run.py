"""Run a study, in this process or on Ray, or resume a run, and assemble its results."""

import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from uavmec_jax.cluster.connection import Cluster, connected
from uavmec_jax.cluster.options import RayOptions
from uavmec_jax.errors import StudyError
from uavmec_jax.files.locations import is_local, reached, remove_folder, to_path
from uavmec_jax.files.locks import lock_folder
from uavmec_jax.files.output_folders import check_directory, check_empty
from uavmec_jax.files.writing import writing_to
from uavmec_jax.runs.file_names import LOG, RUN_PLAN, SHARDS
from uavmec_jax.runs.folder import RunFolder
from uavmec_jax.runs.in_process import OnProgress, run_here
from uavmec_jax.runs.log import OnEvent, RunLog, tensorboard_writer
from uavmec_jax.runs.on_ray import run_on_ray
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.results_folder import (
    assemble_results,
    load_results,
    partial_results,
    read_finished_shards,
)
from uavmec_jax.runs.run_plan import RunPlan, check_shard_size, label_of, plan_run
from uavmec_jax.runs.shard_runner import ShardRunner
from uavmec_jax.runs.signals import StopSignal
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.shard_result import ShardResult
from uavmec_jax.training.machine import probe_node
from uavmec_jax.training.population import Progress

_NAMED = 20
"""Strangers in the folder of a run that its log names."""

RewardFunction = Callable[[Mapping[str, Any]], Any]


def run_study(
    study: Study,
    directory: str | Path | None = None,
    *,
    reward: RewardFunction | None = None,
    command: str | None = None,
    ray: RayOptions | str | bool | None = None,
    shard_size: int | None = None,
    options: RunOptions | None = None,
    on_plan: Callable[[RunPlan], None] = lambda plan: None,
    on_progress: OnProgress = lambda _: None,
    on_event: OnEvent = lambda event, facts: None,
) -> Results:
    """Train and evaluate the population of a study.

    With a directory, the run can be resumed whatever happens, see :func:`resume_run`. Ctrl-C and SIGTERM end it early: the
    results then hold the finished shards, ``run["complete"]`` is False and ``run["stopped_by"]`` is the signal's number.

    Args:
        study: from :func:`um.load_study`.
        directory: folder of the run, a path or a URL such as ``s3://bucket/run``; ``None`` saves nothing.
        reward: a function of the reward's terms (see :func:`um.make_reward`) that replaces the study's reward; the run's
            label then names it.
        command: the command line, for the label of the results.
        ray: put the shards on Ray: ``True`` for the cluster of ``RAY_ADDRESS``, else one on this machine; an address; or
            options. All nodes must have the same version of this package, and reach the directory.
        shard_size: most agents in a shard; by default as many as the devices' caches hold.
        options: how the run is checkpointed and logged.
        on_plan: called with the run plan before anything is trained.
        on_progress: called after every chunk.
        on_event: called with ``(event, facts)`` of everything that is logged.

    Raises:
        ArgumentError: ``shard_size`` is not a positive number.
        StudyError: the population does not fit in memory, the directory cannot take a run or another process works in it,
            shards failed, ``reward`` is given beside an axis of rewards, a package is not installed, Ray cannot be reached,
            or is given without a directory or with a reward function; the directory is a URL, and its object store cannot
            be reached or written to; a folder cannot be written to.
    """
    check_shard_size(shard_size)  # before Ray is started
    if reward is not None and "reward" in study.axes:
        raise StudyError(f"{study.name}: axes.reward is given, and a reward function too; leave one of them out")
    ray = RayOptions.of(ray)
    if ray and (directory is None or reward is not None):
        raise StudyError(f"{study.name}: a run on Ray needs a directory and no reward function")
    path = None if directory is None else to_path(directory)
    options = options or RunOptions()
    if path is not None:
        _check_location(path, ray, tensorboard=options.tensorboard)
        check_directory(path)
    if options.tensorboard:
        tensorboard_writer()
    with nullcontext() if path is None else reached(path), connected(ray) as cluster:
        machine = probe_node(cluster, on_event) if cluster else None
        plan = plan_run(study, shard_size=shard_size, machine=machine)
        on_plan(plan)
        label = label_of(study, plan, command)
        if reward is not None:
            label["reward_function"] = getattr(reward, "__qualname__", repr(reward))
        if path is None:
            return _run_in_memory(study, plan, ShardRunner(study, plan, reward), label, on_progress)
        with writing_to(path, StudyError), lock_folder(path / SHARDS, path):
            check_empty(path)
            folder = RunFolder.create(path, study, plan, options, label)
            return _run(folder, reward, cluster, on_progress, on_event)


def resume_run(
    directory: str | Path,
    *,
    reward: RewardFunction | None = None,
    ray: RayOptions | str | bool | None = None,
    take_over: bool = False,
    other_code: bool = False,
    on_progress: OnProgress = lambda _: None,
    on_event: OnEvent = lambda event, facts: None,
) -> Results:
    """Resume a run that was stopped or killed; its results are those of an uninterrupted run, to the bit.

    Finished shards are kept, the others resume from their last intact checkpoint; failed shards are run again. It does not
    matter whether the run was started on Ray or not, and whether it is resumed there.

    Args:
        directory: folder of the run, a path or a URL.
        reward: the reward function that the run was started with, if any.
        ray: as for :func:`run_study`; by default, a shard has as many cores as its run plan says.
        take_over: resume although the folder names a process on another machine as its owner, which is dead.
        other_code: resume although code or libraries have changed since the run was planned; its label then says so.
        on_progress: called after every chunk.
        on_event: called with ``(event, facts)`` of everything that is logged.

    Raises:
        StudyError: the directory holds no run, the run plan is damaged, another process works in it, its object store
            cannot be reached, it cannot be written to, or the run needs its reward function or was planned with other code.
    """
    ray = RayOptions.of(ray)
    with reached(directory) as path:
        folder = RunFolder.open(path)
        folder.check_reward(reward)
        if folder.complete:
            remove_folder(folder.shards_folder)
            return load_results(path)
        if ray and reward is not None:
            raise StudyError(f"{path}: a run on Ray takes no reward function")
        if ray and not ray.cpus_per_shard and not ray.gpus_per_shard:  # a shard can use as many as the plan says
            groups = max(partition.groups for partition in folder.plan.partitions.values())
            ray = replace(ray, cpus_per_shard=groups)
        _check_location(path, ray)
        if not other_code:
            folder.check_code()
        folder.check_links()
        writing, lock = writing_to(path, StudyError), lock_folder(folder.shards_folder, path, take_over=take_over)
        with writing, lock, connected(ray) as cluster:
            if folder.complete:  # by the process that has just let go of it
                remove_folder(folder.shards_folder)
                return load_results(path)
            folder.remove_partial_files()
            for shard, state, _ in folder.states():
                if state == "failed":
                    folder.failure(shard).unlink(missing_ok=True)
            label = {"other_code": differ} if (differ := folder.other_code()) else {}
            return _run(folder, reward, cluster, on_progress, on_event, label)


def run_or_resume(
    study: Study,
    directory: str | Path,
    *,
    command: str | None = None,
    ray: RayOptions | str | bool | None = None,
    on_progress: OnProgress = lambda _: None,
) -> Results:
    """Run a study in a folder; if it holds a run, resume that, or load its results if it is complete."""
    with reached(directory) as path:
        started = (path / RUN_PLAN).exists()
    if started:
        return resume_run(directory, ray=ray, on_progress=on_progress)
    return run_study(study, directory, command=command, ray=ray, on_progress=on_progress)


def _check_location(path: Path, ray: RayOptions | None, *, tensorboard: bool = False) -> None:
    """Refuse what cannot be done in an object store.

    Raises:
        StudyError: TensorBoard's files are wanted there, or Ray's nodes cannot see it.
    """
    if is_local(path):
        return
    if tensorboard:
        raise StudyError(
            f"{path}: --tensorboard writes files beside the run, which must then be in a folder, not a URL"
        )
    if ray and str(path).startswith("memory:"):
        raise StudyError(f"{path}: is the memory of one process, which the nodes of Ray do not see; give another URL")


def _run(
    folder: RunFolder,
    reward: RewardFunction | None,
    cluster: Cluster | None,
    on_progress: OnProgress,
    on_event: OnEvent,
    label: Mapping[str, Any] = MappingProxyType({}),
) -> Results:
    """Run all shards that are not finished, and assemble the results."""
    log = RunLog(folder.path / LOG, tensorboard=folder.options.tensorboard and cluster is None, on_event=on_event)
    if strangers := folder.strangers():
        log.event("ignored", number=len(strangers), names=strangers[:_NAMED])
    with StopSignal() as stop:
        try:
            damaged = None
            while damaged is None or damaged:
                if cluster is None:
                    run_here(folder, ShardRunner(folder.study, folder.plan, reward), stop, log, on_progress)
                else:
                    run_on_ray(folder, cluster, stop, log, on_progress)
                finished, damaged = read_finished_shards(folder, log.event)
        except KeyboardInterrupt as interrupt:
            results = partial_results(folder)
            results.run["stopped_by"] = getattr(interrupt, "signal", 2)
            return results
        finally:
            log.close()
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

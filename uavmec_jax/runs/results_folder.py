"""Runs on disk: put together from their shards, and read back, whole or as far as they got."""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from uavmec_jax.errors import StudyError
from uavmec_jax.files.leases import Leases, named
from uavmec_jax.runs.folder import PLAN, SHARDS, RunFolder
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.results import RUN, STUDY, Results
from uavmec_jax.studies.results_files import read_results
from uavmec_jax.studies.shard_result import Finished


def check_directory(directory: Path) -> None:
    """Refuse a folder that cannot take a run.

    Raises:
        StudyError: it holds a run or something else, somebody is at work in it, or it is a file.
    """
    if (holder := Leases().holder(directory / SHARDS)) is not None:
        raise StudyError(f"{directory}: {named(holder)} is at work in it{help_with(directory)}")
    check_empty(directory)


def check_empty(directory: Path) -> None:
    """Refuse a folder that holds anything but claims."""
    if holds_run(directory) or (directory / PLAN).exists():
        raise StudyError(
            f"{directory}: already holds a run; go on with it by `uavmec resume`, or give another folder with --out"
        )
    if directory.exists() and not directory.is_dir():
        raise StudyError(f"{directory}: exists and is not an empty folder; give another one with --out")
    if directory.exists() and any(file.name != SHARDS for file in directory.iterdir()):
        raise StudyError(f"{directory}: exists and is not an empty folder; give another one with --out")


def help_with(directory: Path) -> str:
    """What somebody may do who finds a run at work."""
    return f"; to help it, start `uavmec worker {directory}`"


def put_together(folder: RunFolder, shards: Iterable[Finished], **more: Any) -> Results:
    """The results of a run whose shards are all finished; the shards' own files are then no longer needed.

    However often and by whomever it is done, the files are the same. ``more`` is added to the run's label.

    Raises:
        StudyError: an agent is there twice, or missing.
    """
    results = Results.of(folder.study, folder.facts["label"] | more, shards, folder.plan.agents)
    _check_agents(folder, results)
    results.save(folder.path)
    shutil.rmtree(folder.shards_folder, ignore_errors=True)
    return results


def _check_agents(folder: RunFolder, results: Results) -> None:
    """No agent twice, none missing."""
    axes = [name for name in results.agents if name in ("seed", *cell_axes(folder.study))]
    if len(results.agents) != folder.plan.agents or results.agents.duplicated(axes).any():
        raise StudyError(
            f"{folder.path}: its shards hold {len(results.agents):,} agents, the plan has {folder.plan.agents:,}, each once"
        )


def finished_shards(folder: RunFolder) -> list[Finished]:
    """The shards that are finished by now.

    Raises:
        StudyError: the file of one is damaged.
    """
    return [Finished.read(folder.result(shard)) for shard, state, _ in folder.states() if state == "done"]


def partial_results(folder: RunFolder) -> Results:
    """The results of the shards that are finished by now."""
    return Results.of(folder.study, folder.facts["label"], finished_shards(folder), folder.plan.agents)


def sound_shards(folder: RunFolder, tell: Callable[..., None]) -> tuple[list[Finished], list[int]]:
    """The shards that are finished, and the numbers of those whose files are damaged.

    The damaged ones are named and set aside; they are no longer finished.
    """
    sound, damaged = [], []
    for shard in folder.plan.shards:
        path = folder.result(shard)
        if not path.exists():
            continue
        try:
            sound.append(Finished.read(path))
        except StudyError as error:
            tell("damaged", shard=shard.number, file=path.name, error=str(error))
            path.rename(path.with_suffix(".damaged"))
            damaged.append(shard.number)
    return sound, damaged


def holds_run(directory: Path) -> bool:
    """Whether a folder holds the results of a run, or a study."""
    return (directory / RUN).exists() or (directory / STUDY).exists()


def load_results(directory: str | Path) -> Results:
    """Read a run back (all but its weights, see :func:`load_weights`); one that goes on, or was stopped, as far as it is.

    Raises:
        StudyError: the folder holds no run, a file of it is damaged, or it was written by another version.
    """
    directory = Path(directory)
    if not (directory / RUN).exists() and (directory / PLAN).exists():
        return partial_results(RunFolder.open(directory))
    return read_results(directory)

"""Results of runs: assembled from their shards, and loaded again, complete or partial."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from uavmec_jax.errors import StudyError
from uavmec_jax.files.locations import reached, remove_folder
from uavmec_jax.files.writing import set_aside
from uavmec_jax.runs.folder import RUN_PLAN, TOUR, RunFolder
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.results import RUN, Results
from uavmec_jax.studies.results_files import read_results
from uavmec_jax.studies.shard_result import ShardResult


def assemble_results(folder: RunFolder, shards: Iterable[ShardResult], **more: Any) -> Results:
    """Assemble the results of a run whose shards are all finished, and remove the shards' own files.

    Assembling twice gives the same files.

    Args:
        folder: the run.
        shards: the results of all of its shards, in their order.
        more: added to the run's label.

    Raises:
        StudyError: an agent occurs twice, or is missing.
    """
    results = Results.of(folder.study, folder.facts["label"] | more, shards, folder.plan.agents)
    axes = [name for name in results.agents if name in ("seed", *cell_axes(folder.study))]
    if len(results.agents) != folder.plan.agents or results.agents.duplicated(axes).any():
        raise StudyError(
            f"{folder.path}: its shards hold {len(results.agents):,} agents; the plan has {folder.plan.agents:,}, each once"
        )
    results.save(folder.path)
    remove_folder(folder.shards_folder)
    return results


def read_finished_shards(folder: RunFolder, log_event: Callable[..., None]) -> tuple[list[ShardResult], list[int]]:
    """Read the results of finished shards; log and rename damaged files, whose shards then are to be run again.

    Returns:
        The intact results, and the numbers of the shards that have none although they were finished.
    """
    intact, damaged = [], []
    for shard in folder.plan.shards:
        results = folder.results(shard)
        for path in results:
            try:
                intact.append(ShardResult.read(path))
                break
            except StudyError as error:
                log_event("damaged", shard=shard.number, file=path.name, error=str(error))
                set_aside(path)
        else:
            damaged += [shard.number] * bool(results)
    return intact, damaged


def partial_results(folder: RunFolder) -> Results:
    """Assemble the results of the shards that are finished so far, in memory.

    Raises:
        StudyError: the file of a shard is damaged.
    """
    finished = [ShardResult.read(folder.results(shard)[0]) for shard, state, _ in folder.states() if state == "done"]
    return Results.of(folder.study, folder.facts["label"], finished, folder.plan.agents)


def load_results(directory: str | Path) -> Results:
    """Load the results of a run, all but its weights (see :func:`load_weights`), from a folder or a URL.

    Of an unfinished run, the results are those of its finished shards.

    Raises:
        StudyError: the folder holds no run, a file is damaged, another version wrote it, or its object store cannot be
            reached.
    """
    with reached(directory) as path:
        if not (path / RUN).exists() and (path / RUN_PLAN).exists():
            return partial_results(RunFolder.open(path))
        if not (path / RUN).exists() and (path / TOUR).exists():
            raise StudyError(f"{path}: holds no run; it holds a tour of `uavmec plan` ({TOUR})")
        return read_results(path)

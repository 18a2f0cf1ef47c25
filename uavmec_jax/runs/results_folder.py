"""Results of runs: assembled from their shards, and loaded again, complete or partial."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from uavmec_jax.errors import StudyError
from uavmec_jax.files.locations import reached, remove_folder
from uavmec_jax.files.writing import set_aside
from uavmec_jax.runs.file_names import RUN_PLAN, TOUR
from uavmec_jax.runs.folder import RunFolder
from uavmec_jax.runs.run_plan import Shard
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.results import AGENTS, RUN, Results
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
                intact.append(_read_shard(folder, shard, path))
                break
            except StudyError as error:
                log_event("damaged", shard=shard.number, file=path.name, error=str(error))
                set_aside(path)
        else:
            damaged += [shard.number] * bool(results)
    return intact, damaged


def _read_shard(folder: RunFolder, shard: Shard, path: Path) -> ShardResult:
    """Read one result of a shard.

    Raises:
        StudyError: it is damaged, or is not a result of this shard.
    """
    result = ShardResult.read(path)
    result.check(folder.parts[shard.part].study, folder.agent_ids(shard), path)
    return result


def partial_results(folder: RunFolder) -> Results:
    """Assemble the results of the shards that are finished so far, in memory.

    Raises:
        StudyError: the file of a shard is damaged.
    """
    finished = [_first_intact(folder, shard) for shard in folder.plan.shards if folder.results(shard)]
    return Results.of(folder.study, folder.facts["label"], finished, folder.plan.agents)


def _first_intact(folder: RunFolder, shard: Shard) -> ShardResult:
    """Read the first result of a shard that is intact; of several, all hold the same."""
    *others, last = folder.results(shard)
    for path in others:
        with suppress(StudyError):
            return _read_shard(folder, shard, path)
    return _read_shard(folder, shard, last)


def load_results(directory: str | Path) -> Results:
    """Load the results of a run, all but its weights (see :func:`load_weights`), from a folder or a URL.

    Of an unfinished run, the results are those of its finished shards, perhaps of none. If ``run.json`` is lost, the label in
    the run plan stands in for it, and ``run["lost"]`` says so.

    Raises:
        StudyError: the folder holds no run, a file is damaged, another version wrote it, or its object store cannot be
            reached.
    """
    with reached(directory) as path:
        if not (path / RUN).exists() and (path / RUN_PLAN).exists():
            folder = RunFolder.open(path)
            results = partial_results(folder)
            if not len(results.agents) and (path / AGENTS).exists():  # its shards were removed when it was complete
                return read_results(path, folder.facts["label"])
            return results
        if not (path / RUN).exists() and (path / TOUR).exists():
            raise StudyError(f"{path}: holds no run; it holds a tour of `uavmec plan` ({TOUR})")
        return read_results(path)

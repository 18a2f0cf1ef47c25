"""Compare the best settings of a search with the study's own, on scenarios that the search has not seen."""

from collections.abc import Callable
from pathlib import Path

from uavmec_jax.cluster.options import RayOptions
from uavmec_jax.errors import StudyError
from uavmec_jax.runs.file_names import RUN_PLAN
from uavmec_jax.runs.folder import RunFolder
from uavmec_jax.runs.run import run_or_resume
from uavmec_jax.search.search import SearchResult, best_study
from uavmec_jax.studies.compare import Side
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.study import load_study, study_toml
from uavmec_jax.training.population import Progress

BASELINE, BEST = "baseline", "best"
"""Folders of the two runs, inside the folder of the search."""


def confirm(
    result: SearchResult,
    directory: str | Path,
    *,
    command: str | None = None,
    ray: RayOptions | str | bool | None = None,
    on_progress: Callable[[str, Progress], None] = lambda name, progress: None,
) -> tuple[Side, Side]:
    """Train the study with its own and with the best settings on its own scenarios, or load runs that exist.

    Args:
        result: the result of the search.
        directory: folder of the search; the runs are in its folders ``baseline`` and ``best``.
        command: the command line, for the labels of the runs.
        ray: put the shards of the runs on Ray, as for :func:`uavmec_jax.runs.run.run_study`.
        on_progress: called with the name of the run, ``baseline`` or ``best``, and its progress.

    Returns:
        The study with its own settings, and with the best ones.

    Raises:
        KeyboardInterrupt: a signal arrived; the runs can be resumed.
        StudyError: a run is not possible, see :func:`uavmec_jax.runs.run.run_study`; or there is one of other settings.
    """
    space = result.space
    baseline = load_study(space.study, space.change | {"axes.seeds": space.confirm_seeds})
    best = best_study(result)
    best = best.model_copy(update={"axes": best.axes | {"seeds": space.confirm_seeds}})
    sides = []
    for name, study in ((BASELINE, baseline), (BEST, best)):

        def report(progress: Progress, name: str = name) -> None:
            on_progress(name, progress)

        _check_study(Path(directory) / name, study)
        results = run_or_resume(study, Path(directory) / name, command=command, ray=ray, on_progress=report)
        if not results.run["complete"]:
            raise KeyboardInterrupt
        sides.append(Side(results))
    return sides[0], sides[1]


def _check_study(path: Path, study: Study) -> None:
    """Check that a run that is there already, perhaps of a shorter search, is one of this study.

    Raises:
        StudyError: it is not.
    """
    if (path / RUN_PLAN).exists() and study_toml(RunFolder.open(path).study) != study_toml(study):
        raise StudyError(f"{path}: holds a run of another study, perhaps of earlier settings; move it away")

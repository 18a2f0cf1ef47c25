"""What a search gained: the best settings against the study's own, on towns that the search has never seen."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from uavmec_jax.learning.population import Progress
from uavmec_jax.studies.archive import load_results
from uavmec_jax.studies.compare import Side, overall, pair
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.run import resume_run, run_study
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.search.search import Found, best_study
from uavmec_jax.studies.study import load_study

OWN, BEST = "own", "best"
"""Folders of the two runs, in that of the search."""


def confirm(
    found: Found,
    directory: str | Path,
    *,
    command: str | None = None,
    on_progress: Callable[[str, Progress], None] = lambda name, news: None,
) -> tuple[Side, Side]:
    """Train the study with its own and with the best settings, on its own towns; or read what was trained before.

    Args:
        found: by the search.
        directory: of the search; the runs are kept in ``own`` and ``best`` there.
        command: the command line, for the labels.
        on_progress: told ``(own or best, progress)``.
    """
    space = found.space
    seeds = {"axes.seeds": space.confirm_seeds}
    own = load_study(space.study, space.change | seeds)
    best = best_study(found)
    best = best.model_copy(update={"axes": best.axes | {"seeds": space.confirm_seeds}})
    sides = []
    for name, study in ((OWN, own), (BEST, best)):

        def report(news: Progress, name: str = name) -> None:
            on_progress(name, news)

        sides.append(Side(_run(study, Path(directory) / name, command, report)))
    return sides[0], sides[1]


def _run(study: Study, path: Path, command: str | None, report: Callable[[Progress], None]) -> Results:
    if (path / "run.json").exists():
        return load_results(path)
    if (path / "plan.json").exists():
        results = resume_run(path, on_progress=report)
    else:
        results = run_study(study, path, command=command, on_progress=report)
    if not results.run["complete"]:
        raise KeyboardInterrupt
    return results


def gain(own: Side, best: Side) -> dict[str, tuple[float, float, float]]:
    """See :func:`uavmec_jax.studies.compare.overall`: ``difference`` is what the best settings live longer, in slots."""
    both, cells = pair(own, best)
    return overall(both, cells)


def gain_json(own: Side, best: Side) -> dict[str, Any]:
    """The gain as plain data."""
    return {name: dict(zip(("value", "low", "high"), one, strict=True)) for name, one in gain(own, best).items()}

"""What a search gained: the best settings against the study's own, on towns that the search has never seen."""

from collections.abc import Callable
from pathlib import Path

from uavmec_jax.runs.run import run_or_resume
from uavmec_jax.search.search import SearchResult, best_study
from uavmec_jax.studies.compare import Side
from uavmec_jax.studies.study import load_study
from uavmec_jax.training.population import Progress

OWN, BEST = "own", "best"
"""Folders of the two runs, in that of the search."""


def confirm(
    found: SearchResult,
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

    Raises:
        KeyboardInterrupt: a signal came; what was trained is kept.
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

        results = run_or_resume(study, Path(directory) / name, command=command, on_progress=report)
        if not results.run["complete"]:
            raise KeyboardInterrupt
        sides.append(Side(results))
    return sides[0], sides[1]

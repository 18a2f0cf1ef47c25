"""The command that searches hyperparameters."""

import math
from pathlib import Path
from typing import Any

import click

from uavmec_jax.cli.common import Interrupt, command_line, new_folder, print_json, print_tables
from uavmec_jax.cli.options import json_option, out_option

_SIGINT = 2


@click.command()
@click.argument("space")
@click.option("--trials", type=click.IntRange(1), help="Trials in all; a larger number continues a finished search.")
@out_option(help="Folder of the search (default: runs/<space>-<time>).")
@click.option("--no-confirm", is_flag=True, help="Leave out the comparison on the study's own scenarios.")
@json_option
def search(space: str, trials: int | None, out: Path | None, no_confirm: bool, as_json: bool) -> None:
    """Search settings of a study as SPACE says: a space that ships with the package (dqn) or a TOML file.

    With the folder of a search that was stopped as --out, continues it.
    """
    from uavmec_jax.training import host

    host.use_all_cores()
    from rich.console import Console

    from uavmec_jax.reporting import canvas
    from uavmec_jax.reporting.compare import comparison
    from uavmec_jax.reporting.search import history_figure, importance_figure, search_json, search_tables
    from uavmec_jax.search.confirm import confirm
    from uavmec_jax.search.search import BEST, run_search
    from uavmec_jax.search.space import load_space

    loaded = load_space(space, {"trials": trials} if trials else None)
    directory, console = out or new_folder(loaded.name), Console(stderr=as_json)
    console.print(f"[bold]{loaded.name}[/bold]: {loaded.trials} trials of {loaded.study}, {loaded.batch} at a time")
    try:
        with console.status("compiling") as line:
            result = run_search(
                loaded, directory, command=command_line(), on_progress=lambda news: line.update(_describe(news))
            )
            for name, figure in (("history", history_figure(result)), ("importance", importance_figure(result))):
                canvas.save(figure, directory / f"{name}.png")
            data: dict[str, Any] = search_json(result)
            tables = search_tables(result)
            if loaded.confirm_seeds and not no_confirm:
                own, best = confirm(
                    result,
                    directory,
                    command=command_line(),
                    on_progress=lambda name, news: line.update(f"{name} settings: {news.steps / news.total_steps:.0%}"),
                )
                more, compared = comparison(own, best)
                tables |= {
                    f"On scenarios that the search has not seen. {title}": table for title, table in more.items()
                }
                data["gain"] = compared["overall"]
    except KeyboardInterrupt as error:
        raise Interrupt(f"go on with: uavmec search {space} --out {directory}", _SIGINT) from error
    if as_json:
        print_json(data)
        return
    print_tables(console, tables, [f"Best settings as a study: {directory / BEST}"], directory)


def _describe(progress: Any) -> str:
    best = "" if math.isnan(progress.best) else f", best {progress.best:.2f} slots"
    return f"trial {progress.trials} of {progress.total_trials}{best}; batch {progress.share:.0%}, {progress.left} trials left"

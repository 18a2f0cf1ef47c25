"""The command that searches hyperparameters."""

import json
import sys
from pathlib import Path
from typing import Any

import click

from uavmec_jax.cli.common import command_line, new_folder, print_tables


@click.command()
@click.argument("space")
@click.option("--trials", type=click.IntRange(1), help="Trials in all; more than before go on with a search.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the search (default: runs/<space>-<time>).")
@click.option("--no-confirm", is_flag=True, help="Leave out the comparison on the study's own towns.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON on standard output.")
def search(space: str, trials: int | None, out: Path | None, no_confirm: bool, as_json: bool) -> None:
    """Search settings of a study as SPACE says: a space that ships with the package (dqn) or a TOML file.

    Given the folder of a search that was stopped with --out, goes on with it.
    """
    from uavmec_jax.training import host

    host.use_every_core()
    from rich.console import Console

    from uavmec_jax.reporting import canvas
    from uavmec_jax.reporting.compare import comparison
    from uavmec_jax.reporting.search import history_figure, importance_figure, search_json, search_tables
    from uavmec_jax.search import search as searching
    from uavmec_jax.search.confirm import confirm
    from uavmec_jax.search.space import load_space

    wanted = load_space(space, {"trials": trials} if trials else None)
    directory, console = out or new_folder(wanted.name), Console(stderr=as_json)
    console.print(f"[bold]{wanted.name}[/bold]: {wanted.trials} trials of {wanted.study}, {wanted.batch} at a time")
    try:
        with console.status("compiling") as line:
            found = searching.search(
                wanted, directory, command=command_line(), on_progress=lambda news: line.update(_words(news))
            )
            for name, figure in (("history", history_figure(found)), ("importance", importance_figure(found))):
                canvas.save(figure, directory / f"{name}.png")
            told: dict[str, Any] = search_json(found)
            tables = search_tables(found)
            if wanted.confirm_seeds and not no_confirm:
                own, best = confirm(
                    found,
                    directory,
                    command=command_line(),
                    on_progress=lambda name, news: line.update(f"{name} settings: {news.steps / news.of_steps:.0%}"),
                )
                more, compared = comparison(own, best)
                tables |= {f"On towns that the search has not seen. {title}": table for title, table in more.items()}
                told["gain"] = compared["overall"]
    except KeyboardInterrupt:
        click.echo(f"interrupted: go on with: uavmec search {space} --out {directory}", err=True)
        sys.exit(130)
    if as_json:
        click.echo(json.dumps(told, indent=1))
        return
    print_tables(console, tables, [f"Best settings as a study: {directory / searching.BEST}"], directory)


def _words(news: Any) -> str:
    best = "" if news.best != news.best else f", best {news.best:.2f} slots"
    return f"trial {news.trials} of {news.of_trials}{best}; batch {news.share:.0%}, {news.left} trials left in it"

"""The command `search`: hyperparameter search."""

import math
from pathlib import Path
from typing import Any

import click

from uavmec_jax.cli.common import Interrupt, command_line, new_folder, print_json, print_tables
from uavmec_jax.cli.options import json_option, out_option, ray_options
from uavmec_jax.cli.types import NameOrPath, WholeNumber

_SIGINT = 2


@click.command()
@click.argument("space", type=NameOrPath())
@click.option(
    "--trials",
    type=WholeNumber(1, 100_000),
    help="Total number of trials; a larger number continues a finished search.",
)
@out_option(help="Folder of the search (default: runs/<space>-<time>).")
@click.option("--no-confirm", is_flag=True, help="Skip the comparison on the study's own scenarios.")
@ray_options
@json_option
def search(space: str, trials: int | None, out: Path | None, no_confirm: bool, ray: Any, as_json: bool) -> None:
    """Search hyperparameters in SPACE: a search space that ships with the package (dqn), or a TOML file.

    To continue a search that was stopped, give its folder as --out.
    """
    from uavmec_jax.training import host

    host.use_all_cores()
    from rich.text import Text

    from uavmec_jax.cli.console import new_console
    from uavmec_jax.cluster.connection import connected
    from uavmec_jax.reporting import canvas
    from uavmec_jax.reporting.compare import comparison
    from uavmec_jax.reporting.search import history_figure, importance_figure, search_json, search_tables
    from uavmec_jax.search.confirm import confirm
    from uavmec_jax.search.folder import BEST, search_folder
    from uavmec_jax.search.search import continue_search
    from uavmec_jax.search.space import load_space

    loaded = load_space(space, {"trials": trials} if trials else None)
    directory, console = out or new_folder(loaded.name), new_console(stderr=as_json)
    console.print_heading(loaded.name, f"{loaded.trials} trials of {loaded.study}, {loaded.batch} at a time")
    try:
        # one connection for the search and its two runs
        with (
            search_folder(directory, loaded, command_line()),
            console.status("compiling") as line,
            connected(ray),
        ):
            result = continue_search(
                loaded,
                directory,
                ray=ray,
                on_progress=lambda progress: line.update(Text(_describe(progress))),
            )
            for name, figure in (("history", history_figure(result)), ("importance", importance_figure(result))):
                canvas.save(figure, directory / f"{name}.png")
            data: dict[str, Any] = search_json(result)
            tables = search_tables(result)
            if loaded.confirm_seeds and not no_confirm:
                sides = confirm(
                    result,
                    directory,
                    command=command_line(),
                    ray=ray,
                    on_progress=lambda name, progress: line.update(
                        f"{name} settings: {progress.steps / progress.total_steps:.0%}"
                    ),
                )
                compared, differences = comparison(*sides)
                tables |= {
                    f"On scenarios that the search has not seen. {title}": table for title, table in compared.items()
                }
                data["gain"] = differences["overall"]
    except KeyboardInterrupt as error:
        raise Interrupt(f"continue with: uavmec search {space} --out {directory}", _SIGINT) from error
    if as_json:
        print_json(data)
        return
    print_tables(console, tables, [f"Best settings as a study: {directory / BEST}"], directory)


def _describe(progress: Any) -> str:
    """Describe the progress of a search in one line."""
    best = "" if math.isnan(progress.best) else f", best {progress.best:.2f} slots"
    batch = f"batch {progress.batch_share:.0%}, {progress.batch_trials} trials in training"
    return f"{progress.trials} of {progress.total_trials} trials{best}; {batch}"

"""The paper's Table 5: lifetime for every combination of power and communication.

    uv run python experiments/table5_grid.py [--seeds 10] [--study table5-tuned]

The same as `uavmec run table5 --seeds 10`, as a script to start your own from.
"""

import argparse
from pathlib import Path

from rich.console import Console

from uavmec_jax.reporting import canvas, figures, tables
from uavmec_jax.runs.run import run_study
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.study import load_study
from uavmec_jax.training import host


def run(study: str, seeds: int, description: str | None) -> None:
    """Run a study with the options of the command line.

    Args:
        study: run by default.
        seeds: number of seeds by default.
        description: shown by ``--help``.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--study", default=study)
    parser.add_argument("--seeds", type=int, default=seeds)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--out", type=Path, help="default: runs/<study>-script")
    arguments = parser.parse_args()
    host.use_all_cores()
    out = arguments.out or Path("runs") / f"{arguments.study}-script"

    changes = {"axes.seeds": arguments.seeds, "steps": arguments.steps}
    show(run_study(load_study(arguments.study, changes), out), out)


def show(results: Results, out: Path) -> None:
    """Draw the figure of a run and print its tables."""
    canvas.save(figures.run_figure(results), out / "figure.png")
    console = Console()
    for title, table in tables.tables(results).items():
        console.print(title)
        console.print(table)


if __name__ == "__main__":
    run("table5", seeds=10, description=__doc__)

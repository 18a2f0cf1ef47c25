"""The paper's Table 7: the evacuation of a rural town and of a downtown, and which device fails first.

    uv run python experiments/table7_evacuation.py [--seeds 30] [--steps 300000] [--study table7]
    uv run --extra traffic python experiments/table7_evacuation.py --simulate

The same as `uavmec run table7`, with the road maps and an animation of each place. With `--simulate` both evacuations are
simulated anew with SUMO first, and the study runs on those.
"""

import argparse
from pathlib import Path

from uavmec_jax.training import host

host.use_all_cores()

from rich.console import Console  # noqa: E402

from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.reporting import canvas, figures, tables
from uavmec_jax.reporting.animation import save_animation
from uavmec_jax.reporting.road_map import map_figure
from uavmec_jax.runs.run import run_study
from uavmec_jax.scenarios.load import load_scenario
from uavmec_jax.studies.study import load_study
from uavmec_jax.traffic.build import build_evacuation
from uavmec_jax.traffic.evacuation import load_evacuation
from uavmec_jax.traffic.place import load_place

PLACES = ("round_lake", "albany")


def simulate(place: str, folder: Path) -> str:
    """Simulate an evacuation into a file; its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{place}.npz"
    build_evacuation(*load_place(place), on_progress=print).save(path)
    return str(path)


def draw(place: str, folder: Path) -> None:
    """The road map, and one evacuation slot by slot with the best rule flying."""
    folder.mkdir(parents=True, exist_ok=True)
    evacuation = load_evacuation(place)
    canvas.save(map_figure(evacuation), folder / f"{evacuation.name}.png")
    town, draws = load_scenario(None, place=place, powered=8, connected=6, seed=0)
    fly, title = HEURISTICS["earliest-deadline"], f"{evacuation.name}, earliest deadline"
    save_animation(folder / f"{evacuation.name}.gif", evacuation, town.params, town.layout, fly, draws[0], title)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--study", default="table7")
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--simulate", action="store_true", help="simulate both evacuations anew (needs SUMO)")
    parser.add_argument("--out", type=Path, help="default: runs/<study>-script")
    arguments = parser.parse_args()
    out = arguments.out or Path("runs") / f"{arguments.study}-script"
    pictures = out.with_name(f"{out.name}-pictures")

    places = [simulate(place, pictures) for place in PLACES] if arguments.simulate else list(PLACES)
    study = load_study(arguments.study, {"axes.seeds": arguments.seeds, "steps": arguments.steps, "axes.place": places})
    results = run_study(study, out)
    canvas.save(figures.run_figure(results), out / "figure.png")
    console = Console()
    for title, table in tables.tables(results).items():
        console.print(title)
        console.print(table)
    for place in places:
        draw(place, pictures)


if __name__ == "__main__":
    main()

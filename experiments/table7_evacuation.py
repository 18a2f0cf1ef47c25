"""The paper's Table 7: first failures of devices during the evacuation of a rural and of an urban place.

    uv run python experiments/table7_evacuation.py [--seeds 30] [--steps 300000] [--study table7]
    uv run --extra traffic python experiments/table7_evacuation.py --simulate

The same as `uavmec run table7`, with the road maps and an animation of each place. With `--simulate` both evacuations are
first simulated again with SUMO, and the study runs on the results.
"""

import argparse
from pathlib import Path

from table5_grid import show

from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.reporting import canvas
from uavmec_jax.reporting.animation import save_animation
from uavmec_jax.reporting.road_map import map_figure
from uavmec_jax.runs.run import run_study
from uavmec_jax.scenarios.load import load_scenario
from uavmec_jax.studies.study import load_study
from uavmec_jax.traffic.build import build_evacuation
from uavmec_jax.traffic.evacuation import load_evacuation
from uavmec_jax.traffic.place import load_place
from uavmec_jax.training import host

PLACES = ("round_lake", "albany")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--study", default="table7")
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--simulate", action="store_true", help="simulate both evacuations again (needs SUMO)")
    parser.add_argument("--out", type=Path, help="default: runs/<study>-script")
    arguments = parser.parse_args()
    host.use_all_cores()
    out = arguments.out or Path("runs") / f"{arguments.study}-script"
    pictures = out.with_name(f"{out.name}-pictures")

    places = [simulate(place, pictures) for place in PLACES] if arguments.simulate else list(PLACES)
    changes = {"axes.seeds": arguments.seeds, "steps": arguments.steps, "axes.place": places}
    show(run_study(load_study(arguments.study, changes), out), out)
    for place in places:
        draw(place, pictures)


def simulate(place: str, folder: Path) -> str:
    """Simulate an evacuation into a file, and return the path of the file."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{place}.npz"
    build_evacuation(*load_place(place), on_progress=print).save(path)
    return str(path)


def draw(place: str, folder: Path) -> None:
    """Draw the road map, and an animation of the evacuation with the best heuristic."""
    folder.mkdir(parents=True, exist_ok=True)
    evacuation = load_evacuation(place)
    canvas.save(map_figure(evacuation), folder / f"{evacuation.name}.png")
    scenario = load_scenario(place=place, powered=8, connected=6, seed=0)
    policy, (draw,) = HEURISTICS["earliest-deadline"], scenario.draws(1)
    path, title = folder / f"{evacuation.name}.gif", f"{evacuation.name}, earliest deadline"
    save_animation(path, evacuation, scenario.params, scenario.layout, policy, draw, title)


if __name__ == "__main__":
    main()

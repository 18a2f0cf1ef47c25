"""The paper's two training figures (Figure 3): mean episode length over the steps of training.

    uv run python experiments/figure3_training.py --out results/figure3

(a) Two learning rates on one layout, 0.01 and 0.0071, for 1,000,000 steps, and 0.0071 for 400,000 steps.
(b) Three seeds with 8 powered and 8 connected devices.
Thin lines: training episodes between two validations; thick lines: the greedy policy on validation draws, smoothed.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from uavmec_jax.reporting import canvas
from uavmec_jax.runs.run import run_study
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.study import parse_study
from uavmec_jax.training import host

AXES = "[axes]\npowered = [8]\nconnected = [8]\nseeds = {seeds}\nlearning_rate = {learning_rates}\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/figure3"))
    parser.add_argument("--steps", type=int, default=1_000_000)
    arguments = parser.parse_args()
    host.use_all_cores()
    steps = arguments.steps
    long = run(arguments.out, "learning-rates", [0], steps, [0.01, 0.0071])
    short = run(arguments.out, "short", [0], steps * 2 // 5, [0.0071])
    seeds = run(arguments.out, "seeds", [0, 1, 2], steps, [0.0071])

    figure = canvas.new_figure(9, 7)
    top, bottom = figure.subplots(2, 1)
    draw(top, long, 0, f"learning rate 0.01, {steps:,} steps")
    draw(top, long, 1, f"learning rate 0.0071, {steps:,} steps")
    draw(top, short, 0, f"learning rate 0.0071, {short.study.steps:,} steps")
    for agent in range(3):
        draw(bottom, seeds, agent, f"seed {agent}")
    for axis, title in (
        (top, "(a) two learning rates, one layout"),
        (bottom, "(b) three seeds, 8 powered, 8 connected"),
    ):
        axis.set(title=title, xlabel="environment steps", ylabel="episode length, slots")
        axis.grid(alpha=0.3)
        axis.legend()
    canvas.save(figure, arguments.out / "figure3.png")
    columns = ["seed", "learning_rate", "steps", "best_lifetime", "last_lifetime", "oldest_first_lifetime"]
    for results in (long, short, seeds):
        print(results.agents[columns])


def run(out: Path, name: str, seeds: list[int], steps: int, learning_rates: list[float]) -> Results:
    """Train one agent per seed and learning rate."""
    axes = AXES.format(seeds=seeds, learning_rates=learning_rates)
    return run_study(parse_study(axes, name, {"steps": steps, "name": name}), out / name)


def draw(axis: Axes, results: Results, agent: int, label: str) -> None:
    """Draw the training and validation curves of one agent."""
    curves = results.curves["dqn"]
    # The chunks between two validations are averaged.
    ends = np.searchsorted(curves["chunk_steps"], curves["validation_steps"], side="right")
    starts = np.concatenate([[0], ends[:-1]])
    episode_length = curves["episode_length"][agent]
    training = [np.nanmean(episode_length[start:end]) for start, end in zip(starts, ends, strict=True)]
    (line,) = axis.plot(curves["validation_steps"], training, lw=0.8, alpha=0.5)
    smooth = pd.Series(curves["validation"][agent]).rolling(5, center=True, min_periods=1).mean()
    axis.plot(curves["validation_steps"], smooth, lw=1.8, color=line.get_color(), label=label)


if __name__ == "__main__":
    main()

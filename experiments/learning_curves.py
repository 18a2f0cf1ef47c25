"""Learning curves of the Q-learners: best and last weights of the paper's, the tuned and the best one, over the steps.

    uv run python experiments/learning_curves.py [--out results/table5-best]

Reads the finished studies `table5`, `table5-best-dqn` and `table5-best` (250 agents each, the same layouts) and writes
`learning_curves.png`. A point is the mean validation lifetime of all agents; the best weights are those with the highest
validation score so far, so their curve is as optimistic as a maximum over few draws is. Levels are means over the same
layouts on held-out draws: oldest-first, earliest-deadline, and the upper bound.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from uavmec_jax.reporting import canvas
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.studies.results import Results

RUNS = {
    "table5": ("the paper's DQN", "tab:red"),
    "table5-best-dqn": ("tuned DQN", "tab:blue"),
    "table5-best": ("PQN", "tab:green"),
}
"""Study -> label and colour."""
LEVELS = {"oldest-first": "oldest_first", "earliest-deadline": "earliest_deadline"}


def draw_curves(axis: Axes, results: Results, label: str, color: str) -> None:
    """Draw the mean of a study's last and best weights at every validation."""
    (curves,) = results.curves.values()
    steps, scores = curves["validation_steps"], curves["validation"]
    axis.plot(steps, scores.mean(axis=0), color=color, label=f"{label}, last")
    axis.plot(steps, np.maximum.accumulate(scores, axis=1).mean(axis=0), color=color, linestyle=":", label="best")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("results"), help="folder of the three runs")
    parser.add_argument("--out", type=Path, default=Path("results/table5-best"))
    arguments = parser.parse_args()
    runs = {study: load_results(arguments.results / study) for study in RUNS}
    figure = canvas.new_figure(9.0, 5.2)
    axis = figure.subplots()
    for study, (label, color) in RUNS.items():
        draw_curves(axis, runs[study], f"{label} ({study})", color)
    best = runs["table5-best"].agents
    levels = {name: best[f"{column}_lifetime"].mean() for name, column in LEVELS.items()}
    levels["upper bound"] = best["bound_planned"].mean()
    for (name, level), style in zip(levels.items(), ("--", "-.", "-"), strict=True):
        axis.axhline(level, color="black", linewidth=1.0, linestyle=style, label=f"{name}, {level:.1f}")
    axis.set(xlabel="environment steps of an agent", ylabel="lifetime, slots", ylim=(12, None))
    axis.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    canvas.save(figure, arguments.out / "learning_curves.png")


if __name__ == "__main__":
    main()

"""What each piece of the best Q-learner is worth: `table5-best` with 300,000 steps and one setting changed at a time.

    uv run python experiments/q_ablation.py [--runs runs/ablation] [--out results/table5-best]

Every variant trains on the same 56 layouts, eight in each of seven cells, that neither the search nor Table 5 has used, with
the same draws. Lifetimes are shares of the upper bound on these draws; differences from the first variant are paired.
Runs that are finished are not repeated. Writes `ablation.csv` and prints it.
"""

import argparse
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console
from rich.table import Table

from uavmec_jax.runs.run import run_or_resume
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.statistics import mean_interval
from uavmec_jax.studies.study import load_study
from uavmec_jax.training import host

AXES = {
    "cells": [[12, 6], [10, 10], [10, 4], [8, 8], [8, 4], [6, 12], [4, 6]],
}
"""Counts of powered and connected devices."""
FIRST_SEED = 2_000_000
"""Of the layouts."""
CELL = ["powered", "connected"]
VARIANTS: dict[str, dict[str, Any]] = {
    "300,000 steps": {},
    "guide: oldest-first": {"pqn.guide": "oldest-first"},
    "guide: none": {"pqn.guide": "none"},
    "half of the exploration guided": {"pqn.guidance": 0.5},
    "no gap": {"pqn.gap": 0.0},
    "no gap, no guide": {"pqn.gap": 0.0, "pqn.guide": "none"},
    **{
        f"one epsilon of {eps} for all environments": {
            "pqn.exploration_highest_eps": eps,
            "pqn.exploration_lowest_eps": eps,
        }
        for eps in (0.1, 0.14, 0.24)  # in the study, their geometric mean is 0.14, their mean 0.24
    },
    "no layer norm": {"pqn.layer_norm": False},
    "one-step targets": {"pqn.q_lambda": 0.0},
    "no cut at exploratory actions": {"pqn.cut_traces": False},
    "constant learning rate": {"pqn.learning_rate_final": 1.0},
    "constant learning rate, no average": {"pqn.learning_rate_final": 1.0, "pqn.average_weights": False},
    "no average": {"pqn.average_weights": False},
    "gamma 0.98": {"pqn.gamma": 0.98},
    "ages not scaled": {"pqn.age_scale": 1.0},
    "four epochs, half the steps": {"pqn.n_epochs": 4, "steps": 150_000},
    "one epoch, twice the steps": {"pqn.n_epochs": 1, "steps": 600_000},
    "128-128": {"pqn.hidden": [128, 128]},
    "600,000 steps": {"steps": 600_000},
    "1,200,000 steps: the study": {"steps": 1_200_000},
    "1,200,000 steps, guide: none": {"steps": 1_200_000, "pqn.guide": "none"},
    "reward of the paper": {"reward": "U+log(A/O)", "slot_reward": 0.0, "pqn.gamma": 0.98},
}
"""Variants of the study, by name: what they change."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs/ablation"), help="folder of the runs")
    parser.add_argument("--seeds", type=int, default=8, help="layouts in each of the seven cells")
    parser.add_argument("--steps", type=int, help="of every variant, for a test of the script")
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--out", type=Path, default=Path("results/table5-best"))
    arguments = parser.parse_args()
    host.use_all_cores()

    bound = run(arguments, "bound", {"algorithm": "none", "pqn": None, "evaluation.planners": ["bound"]}).agents
    rows: list[dict[str, Any]] = []
    first: Results | None = None
    for name in arguments.variants:
        changes = VARIANTS[name] | {"evaluation.planners": []}
        results = run(arguments, name.replace(":", "").replace(",", "").replace(" ", "-"), changes)
        first = first or results
        rows.append({"variant": name, **summarize(results, bound, first)})
        print(f"{name}: {rows[-1]}", flush=True)
    table = pd.DataFrame(rows)
    arguments.out.mkdir(parents=True, exist_ok=True)
    table.to_csv(arguments.out / "ablation.csv", index=False, float_format="%.5g")
    Console(width=120).print(as_rich(table))


def run(arguments: argparse.Namespace, name: str, changes: dict[str, Any]) -> Results:
    """Run the study with some changes, or go on with its run."""
    seeds = list(range(FIRST_SEED, FIRST_SEED + arguments.seeds))
    draws = {"axes": AXES | {"seeds": seeds}, "evaluation.draws": 20, "evaluation.planner_draws": 20}
    changes = {"steps": 300_000} | changes | ({"steps": arguments.steps} if arguments.steps else {})
    changes = {key: value for key, value in changes.items() if value is not None}
    study = load_study("table5-best", changes | draws)
    return run_or_resume(study, arguments.runs / name, command="uv run python experiments/q_ablation.py")


def summarize(results: Results, bound: pd.DataFrame, first: Results) -> dict[str, float]:
    """Return shares of the bound, %: mean with its 95 % interval over the layouts, worst cell, and seconds per agent.

    Also the difference of the last weights from those of the first variant, in points, with its interval.
    """
    identity = [*CELL, "seed"]
    agents = results.agents.set_index(identity)
    others = first.agents.set_index(identity).reindex(agents.index)
    bounds = bound.set_index(identity)["bound_planned"].reindex(agents.index)
    cells = agents.groupby(level=CELL)["last_lifetime"].mean() / bounds.groupby(level=CELL).mean()
    best, last = (100 * agents[f"{which}_lifetime"].mean() / bounds.mean() for which in ("best", "last"))
    mean, low, high = mean_interval(100 * (agents["last_lifetime"] / bounds).to_numpy())
    gains = 100 * (agents["last_lifetime"] - others["last_lifetime"]) / bounds.mean()
    gain, gain_low, gain_high = mean_interval(gains.to_numpy())
    return {
        "best": best,
        "last": last,
        "last_low": last - (mean - low),
        "last_high": last + (high - mean),
        "difference": gain,
        "difference_low": gain_low,
        "difference_high": gain_high,
        "worst_cell": 100 * cells.min(),
        "seconds_per_agent": results.run["seconds"]["train"] / len(agents),
    }


def as_rich(table: pd.DataFrame) -> Table:
    """Return the ablation as a table."""
    rich = Table(title="Shares of the upper bound, %", title_justify="left")
    for column in ("variant", "best", "last", "95 % interval", "difference", "worst cell", "s per agent"):
        rich.add_column(column, justify="left" if column == "variant" else "right")
    for row in table.itertuples():
        interval = f"{row.last_low:.1f} to {row.last_high:.1f}"
        difference = f"{row.difference:+.1f} ({row.difference_low:+.1f} to {row.difference_high:+.1f})"
        numbers = (f"{row.best:.1f}", f"{row.last:.1f}", interval, difference, f"{row.worst_cell:.1f}")
        rich.add_row(str(row.variant), *numbers, f"{row.seconds_per_agent:.2f}")
    return rich


if __name__ == "__main__":
    main()

"""The generalist on 25 cells x 100 unseen layouts, beside heuristics, planners, the paper's DQN and the upper bound.

    uv run python experiments/generalist_grid.py [--policy generalist] [--out results/generalist]

Heuristics, rollout planner, beam and bound on these layouts and volume draws are those of `results/planning`. The DQN (the
paper's settings, 1,000,000 steps on each layout) is that of `results/table5`, which has the first ten layouts of each cell.
The generalist plays the same draws. Then 256 futures of every layout forecast which device fails first, and the held-out
draws say whether that was right. Writes `grid.csv`, `grid.json`, `reliability.csv` and the figures.
"""

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd
from forecast_quality import ForecastQuality, evaluate_forecasts, forecast_first_failure, with_no_failure
from generalist_figures import ratio_figure, reliability_figure
from jaxtyping import Array, Key
from reports import write_report

from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy
from uavmec_jax.planning.parallel import policy_episodes
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.scenarios.policies import load_policy
from uavmec_jax.studies.population import evaluation_keys, make_agents
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.statistics import mean_interval
from uavmec_jax.training import host

_LADDER = ("oldest_first", "dqn_best", "dqn_last", "generalist", "earliest_deadline", "rollout", "beam", "bound")
_PER_CALL = 250
"""Scenarios that are played together."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="generalist")
    parser.add_argument("--planned", type=Path, default=Path("results/planning"), help="heuristics, planners, bound")
    parser.add_argument("--dqn", type=Path, default=Path("results/table5"), help="agents trained on their layouts")
    parser.add_argument("--samples", type=int, default=256, help="futures of a forecast")
    parser.add_argument("--layouts", type=int, default=100, help="the first of them, in each of the 25 cells")
    parser.add_argument("--out", type=Path, default=Path("results/generalist"))
    arguments = parser.parse_args()
    host.use_all_cores()

    planned, policy = load_results(arguments.planned), load_policy(arguments.policy)
    tick = time.perf_counter()
    table, episodes = play(planned, policy, 25 * arguments.layouts)
    table = with_dqn(table, planned, load_results(arguments.dqn))
    quality = evaluate_policy_forecasts(planned, policy, episodes, arguments.samples)
    seconds = time.perf_counter() - tick
    device_fails = episodes["first_failure"].sum(axis=-1).reshape(-1) > 0.5

    cells = table.groupby(["powered", "connected"], sort=False)[[name for name in _LADDER if name in table]].mean()
    report = {
        "command": "uv run python experiments/generalist_grid.py",
        "towns": int(table["seed"].nunique()),
        "draws": episodes["length"].shape[1],
        **summarize(table, cells.reset_index()),
        "first_failure": {
            "named_right": interval(quality.correct.astype(float)),
            "named_right_where_a_device_fails": interval(quality.correct[device_fails].astype(float)),
            "brier": interval(quality.brier),
            "episodes": len(quality.brier),
            "samples": arguments.samples,
        },
        "seconds": round(seconds, 1),
        **host.describe(),
    }
    write_report(arguments.out / "grid.json", report)
    table.to_csv(arguments.out / "grid.csv", index=False, float_format="%.6g")
    quality.reliability.to_csv(arguments.out / "reliability.csv", index=False, float_format="%.5g")
    ratio_figure(table, arguments.out / "ratios.png")
    reliability_figure(quality.reliability, arguments.out / "reliability.png")
    print(cells.round(2).to_string())
    print(json.dumps({name: report[name] for name in ("lift_percent", "share_of_beam", "first_failure")}, indent=1))


def play(planned: Results, policy: Policy, count: int) -> tuple[pd.DataFrame, dict[str, np.ndarray]]:
    """Return mean lifetimes on the first layouts, one row each, and the policy's episodes, leaves ``[A, D, ...]``."""
    draws = planned.evaluation["bound/lifetime"].shape[1]
    keys = evaluation_keys(planned.study)[:count, :draws]
    batches = []
    for params, layouts, batch_keys in scenario_batches(planned, keys):
        episodes = policy_episodes(policy, params, layouts, batch_keys)
        batches.append({name: np.asarray(leaf) for name, leaf in vars(episodes).items() if leaf is not None})
    episodes = {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}
    table = planned.agents.loc[: count - 1, ["seed", "powered", "connected"]].copy()
    for name in _LADDER:
        if f"{name}/lifetime" in planned.evaluation:
            table[name] = planned.evaluation[f"{name}/lifetime"][:count, :draws].mean(axis=1)
    return table.assign(generalist=episodes["length"].mean(axis=1)), episodes


def scenario_batches(planned: Results, keys: Key[Array, "A D"]) -> Iterator[tuple[Params, Layout, Key[Array, "B D"]]]:
    """Yield parameters, layouts and draws of the first ``A`` scenarios in batches that are played together."""
    scenario, count = make_agents(planned.study).scenario, len(keys)
    for first in range(0, count, _PER_CALL):
        batch = slice(first, min(first + _PER_CALL, count))
        params, layouts = jax.tree.map(lambda leaf, batch=batch: leaf[batch], (scenario.params, scenario.layout))
        yield params, layouts, keys[batch]


def with_dqn(table: pd.DataFrame, planned: Results, trained: Results) -> pd.DataFrame:
    """Add the lifetimes, on the same draws, of agents that were trained on some of the layouts."""
    draws = planned.evaluation["bound/lifetime"].shape[1]
    axes = ["seed", "powered", "connected"]
    lifetimes = trained.agents[axes].assign(
        **{f"dqn_{kind}": trained.evaluation[f"{kind}/lifetime"][:, :draws].mean(axis=1) for kind in ("best", "last")},
        check=trained.evaluation["oldest_first/lifetime"][:, :draws].mean(axis=1),
    )
    merged = table.merge(lifetimes, on=axes, how="left", validate="one_to_one")
    shared = merged["check"].notna()
    if not shared.any() or not np.array_equal(merged.loc[shared, "check"], merged.loc[shared, "oldest_first"]):
        raise SystemExit("the DQN's layouts and draws are not the planners'; run both studies with this version")
    return merged.drop(columns="check")


def evaluate_policy_forecasts(
    planned: Results, policy: Policy, episodes: dict[str, np.ndarray], samples: int
) -> ForecastQuality:
    """Evaluate the forecasts of the first failure over all layouts and held-out draws."""
    keys = evaluation_keys(planned.study)[: len(episodes["length"])]
    forecasts = [
        forecast_first_failure(policy, params, layouts, samples)
        for params, layouts, _ in scenario_batches(planned, keys)
    ]
    happened = with_no_failure(episodes["first_failure"])
    forecast = np.repeat(np.concatenate(forecasts)[:, None], happened.shape[1], axis=1)
    return evaluate_forecasts(forecast.reshape(-1, forecast.shape[-1]), happened.reshape(-1, happened.shape[-1]))


def interval(values: np.ndarray) -> dict[str, float]:
    """Return the mean of values with its 95 % interval."""
    return dict(zip(("mean", "low", "high"), (round(x, 4) for x in mean_interval(values)), strict=True))


def summarize(table: pd.DataFrame, cells: pd.DataFrame) -> dict[str, Any]:
    """Return the lift over oldest-first, cell by cell, the shares of beam and bound, and paired differences."""
    lift = 100 * (cells["generalist"] / cells["oldest_first"] - 1)
    deadline_lift = 100 * (cells["earliest_deadline"] / cells["oldest_first"] - 1)
    paired = table["generalist"] - table["oldest_first"]
    by_cell = [mean_interval(paired[group.index].to_numpy()) for _, group in table.groupby(["powered", "connected"])]
    with_dqn = table.dropna(subset=["dqn_best"])
    return {
        "mean_slots": {name: round(float(table[name].mean()), 3) for name in _LADDER if not name.startswith("dqn")},
        "lift_percent": {
            "mean_over_cells": round(float(lift.mean()), 2),
            "least": round(float(lift.min()), 2),
            "least_slots": round(min(mean for mean, *_ in by_cell), 3),
            "earliest_deadline": round(float(deadline_lift.mean()), 2),
        },
        "share_of_beam": round(float((cells["generalist"] / cells["beam"]).mean()), 4),
        "share_of_bound": round(float((cells["generalist"] / cells["bound"]).mean()), 4),
        "over_earliest_deadline_slots": interval((table["generalist"] - table["earliest_deadline"]).to_numpy()),
        "beside_the_dqn": {
            "towns": int(with_dqn["seed"].nunique()),
            "mean_slots": {name: round(float(with_dqn[name].mean()), 3) for name in _LADDER},
            "over_dqn_best_slots": interval((with_dqn["generalist"] - with_dqn["dqn_best"]).to_numpy()),
        },
    }


if __name__ == "__main__":
    main()

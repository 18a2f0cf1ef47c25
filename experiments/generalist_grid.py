"""The generalist on 25 cells x 100 towns that it has never seen, beside rules, planners, the paper's DQN and the bound.

    uv run python experiments/generalist_grid.py [--policy generalist] [--out results/generalist]

Heuristics, rollout planner, beam and bound on these towns and volume draws are those of `results/planning`, the per-layout
DQN (the paper's settings, 1,000,000 steps in each town) those of `results/table5`, which has the first ten of the towns;
the generalist plays the very same draws. Then 256 futures of every town say which device will fail first, and the held-out
draws whether that was right. Writes `grid.csv`, `grid.json`, `reliability.csv` and the figures.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

from uavmec_jax.training import host

host.use_all_cores()

import jax  # noqa: E402
import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402
from forecast_quality import evaluate_forecasts, forecast_first_failure, with_no_failure
from generalist_figures import ratio_figure, reliability_figure

from uavmec_jax.env.rollout import Policy
from uavmec_jax.planning.parallel import policy_episodes
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.scenarios.policies import load_policy
from uavmec_jax.studies.population import evaluation_keys, make_agents
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.statistics import mean_interval

_LADDER = ("oldest_first", "dqn_best", "dqn_last", "generalist", "earliest_deadline", "rollout", "beam", "bound")
_PER_CALL = 250


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="generalist")
    parser.add_argument("--planned", type=Path, default=Path("results/planning"), help="rules, planners, bound")
    parser.add_argument("--dqn", type=Path, default=Path("results/table5"), help="agents trained in their towns")
    parser.add_argument("--samples", type=int, default=256, help="futures of a forecast")
    parser.add_argument("--towns", type=int, default=100, help="the first of them, in each of the 25 cells")
    parser.add_argument("--out", type=Path, default=Path("results/generalist"))
    arguments = parser.parse_args()

    planned, policy = load_results(arguments.planned), load_policy(arguments.policy)
    tick = time.perf_counter()
    table, played = play(planned, policy, 25 * arguments.towns)
    table = with_dqn(table, planned, load_results(arguments.dqn))
    quality = forecasts(planned, policy, played, arguments.samples)
    spent = time.perf_counter() - tick
    some_device = played["first_failure"].sum(axis=-1).reshape(-1) > 0.5

    cells = table.groupby(["powered", "connected"], sort=False)[[name for name in _LADDER if name in table]].mean()
    report = {
        "command": "uv run python experiments/generalist_grid.py",
        "towns": int(table["seed"].nunique()),
        "draws": played["length"].shape[1],
        **summary(table, cells.reset_index()),
        "first_failure": {
            "named_right": interval(quality.named_right.astype(float)),
            "named_right_where_a_device_fails": interval(quality.named_right[some_device].astype(float)),
            "brier": interval(quality.brier),
            "episodes": len(quality.brier),
            "samples": arguments.samples,
        },
        "seconds": round(spent, 1),
        **host.describe(),
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    table.to_csv(arguments.out / "grid.csv", index=False, float_format="%.6g")
    quality.reliability.to_csv(arguments.out / "reliability.csv", index=False, float_format="%.5g")
    (arguments.out / "grid.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    ratio_figure(table, arguments.out / "ratios.png")
    reliability_figure(quality.reliability, arguments.out / "reliability.png")
    print(cells.round(2).to_string())
    print(json.dumps({name: report[name] for name in ("lift_percent", "share_of_beam", "first_failure")}, indent=1))


def play(planned: Results, policy: Policy, count: int) -> tuple[pd.DataFrame, dict[str, np.ndarray]]:
    """Mean lifetimes of the first towns, one row each, and the generalist's episodes, leaves ``[A, D, ...]``."""
    draws = planned.evaluation["bound/lifetime"].shape[1]
    agents, keys = make_agents(planned.study), evaluation_keys(planned.study)[:count, :draws]
    pieces = []
    for first in range(0, len(keys), _PER_CALL):
        here = slice(first, first + _PER_CALL)
        scenario = jax.tree.map(lambda leaf, here=here: leaf[here], agents.scenario)
        episode = policy_episodes(policy, scenario.params, scenario.layout, keys[here])
        pieces.append({name: np.asarray(leaf) for name, leaf in vars(episode).items()})
    played = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    table = planned.agents.loc[: count - 1, ["seed", "powered", "connected"]].copy()
    for name in _LADDER:
        if f"{name}/lifetime" in planned.evaluation:
            table[name] = planned.evaluation[f"{name}/lifetime"][:count, :draws].mean(axis=1)
    return table.assign(generalist=played["length"].mean(axis=1)), played


def with_dqn(table: pd.DataFrame, planned: Results, trained: Results) -> pd.DataFrame:
    """The table with the lifetimes of agents that were trained in some of the towns, on the same draws."""
    draws = planned.evaluation["bound/lifetime"].shape[1]
    axes = ["seed", "powered", "connected"]
    own = trained.agents[axes].assign(
        **{f"dqn_{kind}": trained.evaluation[f"{kind}/lifetime"][:, :draws].mean(axis=1) for kind in ("best", "last")},
        check=trained.evaluation["oldest_first/lifetime"][:, :draws].mean(axis=1),
    )
    both = table.merge(own, on=axes, how="left", validate="one_to_one")
    shared = both["check"].notna()
    if not shared.any() or not np.array_equal(both.loc[shared, "check"], both.loc[shared, "oldest_first"]):
        raise SystemExit("the DQN's towns and draws are not those of the planners; run both studies with this version")
    return both.drop(columns="check")


def forecasts(planned: Results, policy: Policy, played: dict[str, np.ndarray], samples: int) -> Any:
    """How good the forecasts of the first failure are over all towns and held-out draws."""
    scenario = make_agents(planned.study).scenario
    found = []
    for first in range(0, len(played["length"]), _PER_CALL):
        own = jax.tree.map(lambda leaf, first=first: leaf[first : first + _PER_CALL], scenario)
        found.append(forecast_first_failure(policy, own.params, own.layout, samples))
    happened = with_no_failure(played["first_failure"])
    forecast = np.repeat(np.concatenate(found)[:, None], happened.shape[1], axis=1)
    return evaluate_forecasts(forecast.reshape(-1, forecast.shape[-1]), happened.reshape(-1, happened.shape[-1]))


def interval(values: np.ndarray) -> dict[str, float]:
    """Mean with its 95 % interval."""
    return dict(zip(("mean", "low", "high"), (round(x, 4) for x in mean_interval(values)), strict=True))


def summary(table: pd.DataFrame, cells: pd.DataFrame) -> dict[str, Any]:
    """What was asked: the lift over oldest-first, cell by cell, and the share of the beam and of the bound."""
    lift = 100 * (cells["generalist"] / cells["oldest_first"] - 1)
    paired = table["generalist"] - table["oldest_first"]
    by_cell = [mean_interval(paired[group.index].to_numpy()) for _, group in table.groupby(["powered", "connected"])]
    learned = table.dropna(subset=["dqn_best"])
    own = {name: learned[name].mean() for name in _LADDER}
    return {
        "mean_slots": {name: round(float(table[name].mean()), 3) for name in _LADDER if not name.startswith("dqn")},
        "lift_percent": {
            "mean_over_cells": round(float(lift.mean()), 2),
            "least": round(float(lift.min()), 2),
            "least_slots": round(min(mean for mean, *_ in by_cell), 3),
            "earliest_deadline": round(
                float((100 * (cells["earliest_deadline"] / cells["oldest_first"] - 1)).mean()), 2
            ),
        },
        "share_of_beam": round(float((cells["generalist"] / cells["beam"]).mean()), 4),
        "share_of_bound": round(float((cells["generalist"] / cells["bound"]).mean()), 4),
        "over_earliest_deadline_slots": interval((table["generalist"] - table["earliest_deadline"]).to_numpy()),
        "beside_the_dqn": {
            "towns": int(learned["seed"].nunique()),
            "mean_slots": {name: round(float(value), 3) for name, value in own.items()},
            "over_dqn_best_slots": interval((learned["generalist"] - learned["dqn_best"]).to_numpy()),
        },
    }


if __name__ == "__main__":
    main()

"""What UAVs and a depot are worth: the Markdown tables of `results/fleet/README.md`, from runs of the study `fleet`.

    uv run uavmec run fleet --out results/fleet
    uv run uavmec run fleet --out results/fleet/without_depot --set axes.depots=[0]
    uv run python experiments/fleet_worth.py results/fleet results/fleet/without_depot

Worths are paired differences, on the same layouts and volumes, with 95 % confidence intervals over seeds.
"""

import argparse
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from uavmec_jax.studies.statistics import mean_interval

CELL, POLICIES = ["powered", "connected"], ["oldest_first", "earliest_deadline", "split_deadline", "rollout", "beam"]
LADDER = ["earliest_deadline", "rollout", "beam", "bound"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("with_depot", type=Path, help="run folder of the study")
    parser.add_argument("without_depot", type=Path, help="run folder of the same study without the depot")
    arguments = parser.parse_args()
    fleets, alone = (agents_of(folder) for folder in (arguments.with_depot, arguments.without_depot))
    for uavs in sorted(set(fleets["uavs"])):
        heading(f"{uavs} UAV{'s' * (uavs > 1)}: earliest-deadline / rollout planner / clairvoyant beam / upper bound")
        print_grid(fleets[fleets["uavs"] == uavs], lifetimes)
        print_summary(fleets[fleets["uavs"] == uavs])
    for uavs in sorted(set(fleets["uavs"]))[1:]:
        heading(f"What UAV {uavs} is worth, slots")
        print_grid(paired(fleets, fleets, uavs, uavs - 1), difference)
        print_proofs(fleets, uavs)
    for uavs in sorted(set(fleets["uavs"]) & set(alone["uavs"])):
        heading(f"What the depot is worth to {uavs} UAV{'s' * (uavs > 1)}, slots")
        print_grid(paired(fleets, alone, uavs, uavs), difference)


def agents_of(folder: Path) -> pd.DataFrame:
    """Return the rows of a run, one per scenario and fleet; of planners that were not asked, lifetimes are NaN."""
    return pd.read_csv(folder / "agents.csv")


def heading(text: str) -> None:
    print(f"\n{text}:\n")


def print_grid(rows: pd.DataFrame, entry: Callable[[pd.DataFrame], str]) -> None:
    """Print a Markdown table with a row per number of powered devices and a column per number of connected ones."""
    powered, connected = (sorted(set(rows[name]), reverse=True) for name in CELL)
    print("| powered \\ connected | " + " | ".join(map(str, connected)) + " |")
    print("|---:" * (len(connected) + 1) + "|")
    for p in powered:
        entries = (entry(rows[(rows["powered"] == p) & (rows["connected"] == c)]) for c in connected)
        print(f"| **{p}** | " + " | ".join(entries) + " |")


def lifetimes(rows: pd.DataFrame) -> str:
    """Return the mean lifetimes of a cell; a star marks those of which half or more are censored."""
    rows = rows[rows["bound_planned"].notna()]
    return " / ".join(f"{rows[f'{name}_planned'].mean():.1f}{'*' * is_censored(rows, name)}" for name in LADDER)


def is_censored(rows: pd.DataFrame, policy: str) -> bool:
    return f"{policy}_censored" in rows and bool(rows[f"{policy}_censored"].mean() >= 0.5)


def print_summary(rows: pd.DataFrame) -> None:
    """Print shares of the bound in the cells of which less than half is censored, and how often a tour reaches it."""
    rows = rows[rows["bound_planned"].notna()]
    rows = rows.assign(longest_planned=rows[["rollout_planned", "beam_planned"]].max(axis=1))
    cells = [cell for _, cell in rows.groupby(CELL) if not is_censored(cell, "bound")]
    shown = []
    for name in [*POLICIES, "longest"]:
        shares = [100 * cell[f"{name}_planned"].mean() / cell["bound_planned"].mean() for cell in cells]
        shown.append(f"{name.replace('_', '-')} {np.mean(shares):.1f} (least {min(shares):.1f})")
    counted = pd.concat(cells)
    optimal = 100 * (counted["longest_planned"] >= counted["bound_planned"]).mean()
    print(f"\n{len(cells)} cells, {len(counted)} scenarios; share of the bound, %: {', '.join(shown)}.")
    print(f"The longer tour of rollout planner and beam reaches the bound in {optimal:.0f} % of them.")


def paired(a: pd.DataFrame, b: pd.DataFrame, uavs_a: int, uavs_b: int) -> pd.DataFrame:
    """Return the scenarios of two fleets side by side, those of the second with the suffix ``_b``."""
    keys = [*CELL, "seed"]
    return a[a["uavs"] == uavs_a].merge(b[b["uavs"] == uavs_b], on=keys, suffixes=("", "_b"))


def difference(rows: pd.DataFrame) -> str:
    """Return the mean difference of the rollout planner's lifetimes with its confidence interval."""
    mean, low, high = mean_interval((rows["rollout_planned"] - rows["rollout_planned_b"]).to_numpy())
    return f"{mean:+.1f} [{low:+.1f}, {high:+.1f}]{'*' * is_censored(rows, 'rollout')}"


def print_proofs(fleets: pd.DataFrame, uavs: int) -> None:
    """Print in how many scenarios it is proved what one UAV more brings: nothing, or something."""
    both = paired(fleets, fleets, uavs, uavs - 1)
    both = both[both["bound_planned"].notna()]
    before, now = (best_of(both, (f"{name}_planned{suffix}" for name in POLICIES)) for suffix in ("_b", ""))
    proofs = both.assign(nothing=both["bound_planned"] <= before, something=now > both["bound_planned_b"])
    by_power = 100 * proofs.groupby("powered")[["nothing", "something"]].mean().iloc[::-1]
    print(
        f"\nProved in % of {len(both)} scenarios that UAV {uavs} brings nothing / something, by powered devices: ",
        end="",
    )
    print(", ".join(f"{p}: {row.nothing:.0f} / {row.something:.0f}" for p, row in by_power.iterrows()) + ".")


def best_of(rows: pd.DataFrame, columns: Iterable[str]) -> pd.Series:
    names: Sequence[str] = list(columns)
    return rows[names].max(axis=1)


if __name__ == "__main__":
    main()

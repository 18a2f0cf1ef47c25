"""Rewards against algorithms: the paper's Table 6 and studies like it."""

from collections.abc import Iterator
from typing import Any

import pandas as pd
from rich.table import Table
from rich.text import Text

from uavmec_jax.studies.paper import TABLE6
from uavmec_jax.studies.results import Results

ALGORITHM_NAMES = {"dqn": "DQN", "ppo": "PPO", "a2c": "A2C"}


def is_comparison(results: Results) -> bool:
    """Whether a study holds rewards against algorithms and nothing else."""
    axes = set(results.study.axes) - {"powered", "connected", "cells", "seeds", "guard"}
    return axes == {"algorithm", "reward"}


def label_rewards(cells: pd.DataFrame) -> list[str]:
    """Name of each cell's reward; those that stand there under a second guard name it."""
    if "guard" not in cells:
        return [str(reward) for reward in cells["reward"]]
    first = cells["guard"].iloc[0]
    pairs = zip(cells["reward"], cells["guard"], strict=True)
    return [f"{reward}" if guard == first else f"{reward}  ({guard})" for reward, guard in pairs]


def comparison_tables(cells: pd.DataFrame) -> dict[str, Table]:
    """The paper's table for the best and for the last weights."""
    below = "below: maximum over the seeds / the paper's maximum"
    guard = f"; logarithms guarded by {cells['guard'].iloc[0]} where nothing else is said" if "guard" in cells else ""
    return {
        f"Lifetime in slots, `{name}` weights, mean over the seeds ± 95 %; {below}{guard}": comparison_table(
            cells, name
        )
        for name in ("best", "last")
    } | {"Lifetime in slots of those who learn nothing, on the same layouts": _others(cells)}


def comparison_table(cells: pd.DataFrame, policy: str) -> Table:
    """Rows: rewards. Columns: cells, and in them the algorithms. The best mean of each column is bold."""
    cells = cells.assign(reward_shown=label_rewards(cells))
    places = list(dict.fromkeys(zip(cells.powered, cells.connected, strict=True)))
    columns = [(*place, algorithm) for place in places for algorithm in dict.fromkeys(cells["algorithm"])]
    table = Table()
    table.add_column("reward", no_wrap=True)
    for powered, connected, algorithm in columns:
        table.add_column(f"{powered}/{connected}\n{ALGORITHM_NAMES[algorithm]}", justify="right", no_wrap=True)
    keyed = cells.set_index(["powered", "connected", "algorithm", "reward_shown"])
    highest = {column: keyed.loc[column][policy].max() for column in columns}
    for shown in dict.fromkeys(cells["reward_shown"]):
        found = [keyed.loc[(*column, shown)] for column in columns]
        texts = [_entry(cell, column, policy, highest[column]) for cell, column in zip(found, columns, strict=True)]
        table.add_row(shown, *texts)
    return table


def _entry(cell: Any, column: tuple[int, int, str], policy: str, highest: float) -> Text:
    paper = TABLE6.get((cell["reward"], *column))
    half = (cell[f"{policy}_high"] - cell[f"{policy}_low"]) / 2
    text = Text(f"{cell[policy]:.1f}", style="bold" if cell[policy] == highest else "default")
    text.append(f" ±{half:.1f}" if half == half else " ±?", style="dim not bold")
    text.append(f"\n{cell[f'{policy}_max']:.1f}", style="not bold")
    return text.append(f" / {paper:g}" if paper is not None else " / -", style="dim not bold")


def _others(cells: pd.DataFrame) -> Table:
    """Heuristics, planners and bound: the same for every reward and algorithm."""
    names = list(_untrained(cells))
    table = Table()
    for name in ("powered / connected", *names):
        table.add_column(name.removesuffix("_planned").replace("_", "-"), justify="right")
    for (powered, connected), group in cells.groupby(["powered", "connected"], sort=False):
        table.add_row(f"{powered} / {connected}", *(f"{group[name].iloc[0]:.1f}" for name in names))
    return table


def _untrained(cells: pd.DataFrame) -> Iterator[str]:
    for name in cells:
        heuristic = f"{name}_fixed" in cells and name not in ("best", "last")
        if heuristic or name in ("rollout_planned", "beam_planned", "bound_planned"):
            yield str(name)

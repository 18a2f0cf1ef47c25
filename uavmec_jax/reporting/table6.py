"""Rewards against algorithms: the paper's Table 6 and studies like it."""

from collections.abc import Iterator
from typing import Any

import pandas as pd
from rich.table import Table
from rich.text import Text

from uavmec_jax.reporting.formatting import half_interval
from uavmec_jax.studies.paper import TABLE6
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.schema import PLANNERS


def is_table6(results: Results) -> bool:
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


def table6_tables(cells: pd.DataFrame) -> dict[str, Table]:
    """The paper's table, one for each of its columns of cells, and those who learn nothing."""
    guard = f"; logarithms guarded by {cells['guard'].iloc[0]} where nothing else is said" if "guard" in cells else ""
    how = f"best weights: mean over the seeds ± 95 %; maximum / the paper's maximum; last weights{guard}"
    places = dict.fromkeys(zip(cells.powered, cells.connected, strict=True))
    return {
        f"{powered} powered, {connected} connected: lifetime in slots, {how}": table6_table(
            cells[(cells.powered == powered) & (cells.connected == connected)]
        )
        for powered, connected in places
    } | {"Lifetime in slots of those who learn nothing, on the same layouts": _others(cells)}


def table6_table(cells: pd.DataFrame) -> Table:
    """One place of Table 6: rewards down, algorithms across. The best mean of each algorithm is bold."""
    cells = cells.assign(reward_shown=label_rewards(cells))
    algorithms = list(dict.fromkeys(cells["algorithm"]))
    table = Table()
    table.add_column("reward")
    for algorithm in algorithms:
        table.add_column(algorithm.upper(), justify="right", no_wrap=True)
    keyed: Any = cells.set_index(["algorithm", "reward_shown"], drop=False)
    highest = {algorithm: keyed.loc[algorithm]["best"].max() for algorithm in algorithms}
    for shown in dict.fromkeys(cells["reward_shown"]):
        entries = [
            _entry(keyed.loc[(algorithm, shown)], highest[algorithm]) if (algorithm, shown) in keyed.index else Text("")
            for algorithm in algorithms  # an interrupted run has holes
        ]
        table.add_row(shown, *entries)
    return table


def _entry(cell: Any, highest: float) -> Text:
    paper = TABLE6.get((cell["reward"], cell["powered"], cell["connected"], cell["algorithm"]))
    text = Text(f"{cell['best']:.1f}", style="bold" if cell["best"] == highest else "default")
    text.append(half_interval(cell["best_low"], cell["best_high"]), style="dim not bold")
    text.append(f"\n{cell['best_max']:.1f}", style="not bold")
    text.append(f" / {paper:g}" if paper is not None else " / -", style="not bold")
    text.append(f"\n{cell['last']:.1f}", style="dim not bold")
    return text.append(half_interval(cell["last_low"], cell["last_high"]), style="dim not bold")


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
    for name in map(str, cells):
        heuristic = f"{name}_fixed" in cells and name not in ("best", "last")
        if heuristic or name.removesuffix("_planned") in PLANNERS:
            yield name

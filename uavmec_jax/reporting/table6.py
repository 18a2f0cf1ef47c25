"""Rewards by algorithms: the paper's Table 6 and studies like it."""

from collections.abc import Iterator
from typing import Any

import pandas as pd
from rich.table import Table
from rich.text import Text

from uavmec_jax.reporting.formatting import censored, column_name, half_interval, slots
from uavmec_jax.studies.paper import TABLE6
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.schema import PLANNERS


def is_table6(results: Results) -> bool:
    """Return whether the axes of a study are rewards and algorithms and nothing else."""
    axes = set(results.study.axes) - {"powered", "connected", "cells", "seeds", "guard"}
    return axes == {"algorithm", "reward"}


def label_rewards(cells: pd.DataFrame) -> list[str]:
    """Return the reward of each cell, with its guard where that is not the first one of the study."""
    if "guard" not in cells:
        return [str(reward) for reward in cells["reward"]]
    first = cells["guard"].iloc[0]
    pairs = zip(cells["reward"], cells["guard"], strict=True)
    return [f"{reward}" if guard == first else f"{reward}  ({guard})" for reward, guard in pairs]


def table6_tables(cells: pd.DataFrame) -> dict[str, Table]:
    """Return tables by title: one for each pair of counts of powered and connected devices, and one without training."""
    guard = (
        f"; logarithms guarded by {cells['guard'].iloc[0]} unless the row names another guard"
        if "guard" in cells
        else ""
    )
    content = f"best weights: mean over the seeds ± 95 %; maximum / the paper's maximum; last weights{guard}"
    pairs = dict.fromkeys(zip(cells.powered, cells.connected, strict=True))
    tables = {
        f"{powered} powered, {connected} connected: lifetime in slots, {content}": table6_table(
            cells[(cells.powered == powered) & (cells.connected == connected)]
        )
        for powered, connected in pairs
    }
    return tables | {"Lifetime in slots without training, on the same layouts": _untrained_table(cells)}


def table6_table(cells: pd.DataFrame) -> Table:
    """Return one column of Table 6 as a table: rewards down, algorithms across; the best mean per algorithm is bold."""
    cells = cells.assign(label=label_rewards(cells))
    algorithms = list(dict.fromkeys(cells["algorithm"]))
    table = Table()
    table.add_column("reward")
    for algorithm in algorithms:
        table.add_column(algorithm.upper(), justify="right", no_wrap=True)
    indexed: Any = cells.set_index(["algorithm", "label"], drop=False)
    highest = {algorithm: indexed.loc[algorithm]["best"].max() for algorithm in algorithms}
    for label in dict.fromkeys(cells["label"]):
        entries = [
            _entry(indexed.loc[(algorithm, label)], highest[algorithm])
            if (algorithm, label) in indexed.index
            else Text("")  # not there yet: the run was interrupted
            for algorithm in algorithms
        ]
        table.add_row(label, *entries)
    return table


def _entry(cell: Any, highest: float) -> Text:
    paper = TABLE6.get((cell["reward"], cell["powered"], cell["connected"], cell["algorithm"]))
    text = Text(f"{cell['best']:.1f}", style="bold" if cell["best"] == highest else "default")
    text.append(half_interval(cell["best_low"], cell["best_high"]) + censored(cell, "best"), style="dim not bold")
    text.append(f"\n{cell['best_max']:.1f}", style="not bold")
    text.append(f" / {paper:g}" if paper is not None else " / -", style="not bold")
    text.append(f"\n{cell['last']:.1f}", style="dim not bold")
    return text.append(
        half_interval(cell["last_low"], cell["last_high"]) + censored(cell, "last"), style="dim not bold"
    )


def _untrained_table(cells: pd.DataFrame) -> Table:
    """Lifetimes of heuristics, planners and bound, which are the same for every reward and algorithm."""
    policies = list(_untrained_policies(cells))
    table = Table()
    for column in ("powered / connected", *policies):
        table.add_column(column_name(column.removesuffix("_planned")), justify="right")
    for (powered, connected), group in cells.groupby(["powered", "connected"], sort=False):
        table.add_row(f"{powered} / {connected}", *(slots(group[policy].iloc[0]) for policy in policies))
    return table


def _untrained_policies(cells: pd.DataFrame) -> Iterator[str]:
    for name in map(str, cells):
        heuristic = f"{name}_fixed" in cells and name not in ("best", "last")
        if heuristic or name.removesuffix("_planned") in PLANNERS:
            yield name

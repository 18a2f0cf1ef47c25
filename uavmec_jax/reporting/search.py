"""Tables, figures and plain data of a hyperparameter search."""

import json
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.table import Table

from uavmec_jax.reporting.canvas import PALETTE, legend_beside, literal, new_figure
from uavmec_jax.search.search import SearchResult
from uavmec_jax.search.space import baseline_settings

_MAX_TRIALS = 4
"""Trials in the table."""


def search_tables(result: SearchResult) -> dict[str, Table]:
    """Return tables by title: the best trials beside the study's own settings, and the importance of each setting."""
    trials = result.trials
    best = trials[trials["state"] == "complete"].sort_values("value", ascending=False).head(_MAX_TRIALS)
    trial_table = Table()
    for column in ("setting", "study", *(f"trial {number}" for number in best["number"])):
        trial_table.add_column(column, justify="left" if column == "setting" else "right")
    trial_table.add_row("slots", "", *(f"{value:.2f}" for value in best["value"]), end_section=True)
    for setting, baseline in baseline_settings(result.space).items():
        trial_table.add_row(setting, _format(baseline), *(_format(value) for value in best[setting]))
    importance_table = Table()
    importance_table.add_column("setting")
    importance_table.add_column("importance", justify="right")
    for setting, share in result.importance.items():
        importance_table.add_row(setting, f"{share:.0%}")
    objective = "mean lifetime" if result.space.objective == "mean" else "lower end of the mean lifetime's interval"
    counts = trials["state"].value_counts()
    title = f"Best of {counts.get('complete', 0)} complete trials ({counts.get('pruned', 0)} more were pruned)"
    tables = {f"{title}; {objective} on the validation scenarios": trial_table}
    return tables | ({"Importance of each setting for the objective": importance_table} if result.importance else {})


def _format(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def history_figure(result: SearchResult) -> Figure:
    """Return the objective of every trial, pruned ones as crosses, and the best so far."""
    trials, figure = result.trials, new_figure(7.0, 4.0)
    axis = figure.add_subplot()
    complete, pruned = trials[trials["state"] == "complete"], trials[trials["state"] == "pruned"]
    axis.plot(pruned["number"], pruned["value"], "x", color="#7F7F7F", label="pruned, value at its last rung")
    axis.plot(complete["number"], complete["value"], "o", color=PALETTE[0], label="complete")
    axis.step(complete["number"], complete["value"].cummax(), where="post", color=PALETTE[3], label="best so far")
    axis.set(xlabel="trial", ylabel="lifetime, slots", title=literal(result.space.name))
    legend_beside(axis)
    axis.grid(alpha=0.3)
    return figure


def importance_figure(result: SearchResult) -> Figure:
    """Return the objective of every trial over each setting, with the setting's importance."""
    settings = list(result.importance) or list(result.space.space)
    figure = new_figure(9.0, 0.5 + 1.6 * len(settings))
    axes = figure.subplots(len(settings), 1, squeeze=False)[:, 0]
    trials = result.trials
    for axis, setting in zip(axes, settings, strict=True):
        positions, labels = _positions(trials[setting])
        colour = np.where(trials["state"] == "complete", PALETTE[0], "lightgray")
        axis.scatter(positions, trials["value"], c=colour, s=14)
        if labels is None and getattr(result.space.space[setting], "log", False):
            axis.set_xscale("log")
        elif labels is not None:
            axis.set_xticks(range(len(labels)), [literal(label) for label in labels])
        share = result.importance.get(setting)
        axis.set_title(
            literal(setting) + ("" if share is None else f": importance {share:.0%}"), fontsize=9, loc="left"
        )
        axis.set_ylabel("slots", fontsize=8)
        axis.grid(alpha=0.3)
    return figure


def _positions(values: pd.Series) -> tuple[np.ndarray, list[str] | None]:
    """Return positions on an axis: numbers as they are; the indices of other values, with their labels."""
    if values.dtype.kind in "if":
        return values.to_numpy(), None
    labels = sorted(values.astype(str).unique())
    return values.astype(str).map(labels.index).to_numpy(), labels


def search_json(result: SearchResult) -> dict[str, Any]:
    """Return the result as plain data; ``uavmec search --json`` prints it."""
    return {
        "space": result.space.model_dump(mode="json"),
        "best": result.best,
        "value": result.value,
        "baseline_value": result.baseline_value,
        "importance": result.importance,
        "trials": json.loads(result.trials.to_json(orient="records")),
    }

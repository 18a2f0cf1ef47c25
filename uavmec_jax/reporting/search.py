"""Tables and figures of a search."""

import json
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.table import Table

from uavmec_jax.reporting.canvas import new_figure
from uavmec_jax.search.search import SearchResult
from uavmec_jax.search.space import baseline_settings

_SHOWN = 4
"""Trials in the table."""


def search_tables(found: SearchResult) -> dict[str, Table]:
    """The best trials, and what matters, by title."""
    trials = found.trials
    done = trials[trials["state"] == "complete"].sort_values("value", ascending=False).head(_SHOWN)
    what = "mean lifetime" if found.space.objective == "mean" else "lower end of the mean lifetime's interval"
    best = Table()
    for name in ("setting", "study", *(f"trial {number}" for number in done["number"])):
        best.add_column(name, justify="left" if name == "setting" else "right")
    best.add_row("slots", "", *(f"{value:.2f}" for value in done["value"]), end_section=True)
    for name, own in baseline_settings(found.space).items():
        best.add_row(name, _short(own), *(_short(value) for value in done[name]))
    importance = Table()
    importance.add_column("setting")
    importance.add_column("importance", justify="right")
    for name, share in found.importance.items():
        importance.add_row(name, f"{share:.0%}")
    counts = trials["state"].value_counts()
    titles = {
        f"Best of {counts.get('complete', 0)} trials trained to the end ({counts.get('pruned', 0)} given up); {what} on "
        "validation towns": best
    }
    return titles | ({"What the objective hangs on": importance} if found.importance else {})


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def history_figure(found: SearchResult) -> Figure:
    """The objective trial by trial, those given up as crosses, and the best so far."""
    trials, figure = found.trials, new_figure(7.0, 4.0)
    axis = figure.add_subplot()
    done, pruned = trials[trials["state"] == "complete"], trials[trials["state"] == "pruned"]
    axis.plot(pruned["number"], pruned["value"], "x", color="tab:gray", label="given up, when it was")
    axis.plot(done["number"], done["value"], "o", color="tab:blue", label="trained to the end")
    axis.step(done["number"], done["value"].cummax(), where="post", color="tab:orange", label="best so far")
    axis.set(xlabel="trial", ylabel="lifetime, slots", title=found.space.name)
    axis.legend(loc="lower right")
    axis.grid(alpha=0.3)
    return figure


def importance_figure(found: SearchResult) -> Figure:
    """What the objective hangs on, and where along each setting the good trials are."""
    names = list(found.importance) or list(found.space.space)
    figure = new_figure(9.0, 0.5 + 1.6 * len(names))
    axes = figure.subplots(len(names), 1, squeeze=False)[:, 0]
    done = found.trials
    for axis, name in zip(axes, names, strict=True):
        values, labels = _positions(done[name])
        colour = np.where(done["state"] == "complete", "tab:blue", "lightgray")
        axis.scatter(values, done["value"], c=colour, s=14)
        if labels is None and getattr(found.space.space[name], "log", False):
            axis.set_xscale("log")
        elif labels is not None:
            axis.set_xticks(range(len(labels)), labels)
        share = found.importance.get(name)
        axis.set_title(name + ("" if share is None else f": importance {share:.0%}"), fontsize=9, loc="left")
        axis.set_ylabel("slots", fontsize=8)
        axis.grid(alpha=0.3)
    return figure


def _positions(values: pd.Series) -> tuple[np.ndarray, list[str] | None]:
    """Numbers as they are, words as places with labels."""
    if values.dtype.kind in "if":
        return values.to_numpy(), None
    labels = sorted(values.astype(str).unique())
    return values.astype(str).map(labels.index).to_numpy(), labels


def search_json(found: SearchResult) -> dict[str, Any]:
    """What a program may read."""
    return {
        "space": found.space.model_dump(mode="json"),
        "best": found.best,
        "value": found.value,
        "own_value": found.own_value,
        "importance": found.importance,
        "trials": json.loads(found.trials.to_json(orient="records")),
    }

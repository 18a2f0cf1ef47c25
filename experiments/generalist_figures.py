"""Figures of the generalist: distance from the bound, training, reliability of its forecasts, and traffic."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from uavmec_jax.reporting.canvas import new_figure, save
from uavmec_jax.reporting.heat_map import heat_map_figure
from uavmec_jax.reporting.tables import display_name

PAPER_TRAINING_S = 660.0
"""The paper, section 5: a DQN's training takes about 11 minutes per scenario on its GPU."""


def ratio_figure(table: pd.DataFrame, path: Path) -> None:
    """Draw lifetimes as percentages of the upper bound, cell by cell: heat maps of oldest-first, generalist and beam.

    Args:
        table: one row per layout with ``powered``, ``connected`` and the lifetime of each policy and of ``bound``.
        path: where the figure is written.
    """
    names = [name for name in ("oldest_first", "generalist", "beam") if name in table]
    cells = table.groupby(["powered", "connected"], sort=False)[[*names, "bound"]].mean().reset_index()
    ratios = cells.assign(**{name: 100 * cells[name] / cells["bound"] for name in names})
    panels = [(name, f"{display_name(name)}: {ratios[name].mean():.1f} %") for name in names]
    save(heat_map_figure([(ratios, panels)], (70.0, 100.0), "lifetime, % of the upper bound"), path)


def reliability_figure(bins: pd.DataFrame, path: Path) -> None:
    """Draw the reliability diagram: the share of the forecasts of each probability that came true.

    Args:
        bins: see :class:`forecast_quality.ForecastQuality`.
        path: where the figure is written.
    """
    figure = new_figure(4.6, 4.6)
    axis = figure.subplots()
    axis.plot([0, 1], [0, 1], color="0.7", linewidth=1, label="perfectly reliable")
    axis.plot(bins["forecast"], bins["happened"], "o-", label="forecasts, ten bins")
    for _, row in bins.iterrows():
        axis.annotate(
            f"{row['count']:,.0f}",
            (row["forecast"], row["happened"]),
            fontsize=7,
            xytext=(4, -9),
            textcoords="offset points",
        )
    axis.set_xlabel("forecast probability of failing first")
    axis.set_ylabel("share that did")
    axis.legend(frameon=False)
    save(figure, path)


def training_figure(curve: Mapping[str, Any], path: Path) -> None:
    """Draw the lifetime on unseen layouts over the seconds of training, with the paper's 11 minutes marked.

    Args:
        curve: ``ppo`` with ``seconds`` and ``slots``; ``dqn`` likewise, for agents that are trained on their own layouts;
            ``lines``: mean lifetimes without training, by policy.
        path: where the figure is written.
    """
    figure = new_figure(7.2, 4.4)
    axis = figure.subplots()
    axis.plot(curve["ppo"]["seconds"], curve["ppo"]["slots"], "o-", label="generalist, trained once for all layouts")
    if "dqn" in curve:
        axis.plot(
            curve["dqn"]["seconds"], curve["dqn"]["slots"], "s--", label="the paper's DQN, trained on each layout"
        )
    for number, (name, slots) in enumerate(curve["lines"].items()):
        axis.axhline(slots, color="0.6", linewidth=0.8)
        side = "top" if number % 2 else "bottom"  # so that close lines have readable labels
        axis.annotate(display_name(name), (0.01, slots), xycoords=("axes fraction", "data"), fontsize=8, va=side)
    axis.axvline(PAPER_TRAINING_S, color="tab:red", linewidth=1, linestyle=":")
    axis.annotate(
        "the paper's 11 minutes",
        (PAPER_TRAINING_S, 0.03),
        xycoords=("data", "axes fraction"),
        fontsize=8,
        rotation=90,
        ha="right",
        color="tab:red",
    )
    axis.set_xscale("log")
    axis.set_xlabel("seconds of training on this machine")
    axis.set_ylabel("mean lifetime over the grid, slots")
    axis.legend(frameon=False, loc="center", bbox_to_anchor=(0.55, 0.5))
    save(figure, path)


def trade_off_figure(table: pd.DataFrame, path: Path) -> None:
    """Draw the lifetime over the share of first failures on devices in high traffic, one point per price.

    Args:
        table: columns ``place``, ``price``, ``lifetime``, ``busy_first``.
        path: where the figure is written.
    """
    places = list(dict.fromkeys(table["place"]))
    figure = new_figure(3.6 * len(places), 3.6)
    axes = np.atleast_1d(figure.subplots(1, len(places)))
    for axis, place in zip(axes, places, strict=True):
        rows = table[table["place"] == place]
        axis.plot(100 * rows["busy_first"], rows["lifetime"], "o-")
        for _, row in rows.iterrows():
            axis.annotate(
                f"{row['price']:g}",
                (100 * row["busy_first"], row["lifetime"]),
                fontsize=8,
                xytext=(4, 3),
                textcoords="offset points",
            )
        axis.set_title(place)
        axis.set_xlabel("first failures in high traffic, %")
    axes[0].set_ylabel("mean lifetime, slots; numbers: price, slots")
    save(figure, path)

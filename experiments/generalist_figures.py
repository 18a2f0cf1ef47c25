"""Figures of the generalist: how near the bound, how soon, how reliable its forecasts, what traffic costs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from uavmec_jax.reporting.canvas import new_figure, save
from uavmec_jax.reporting.tables import display_name

PAPER_TRAINING_S = 660.0
"""The paper, section 5: a DQN's training takes about 11 minutes per scenario on its GPU."""


def ratio_figure(table: pd.DataFrame, path: Path) -> None:
    """Lifetimes over the upper bound's, cell by cell: heat maps of oldest-first, generalist and beam.

    Args:
        table: a row per town with ``powered``, ``connected`` and a lifetime per policy, ``bound`` among them.
        path: of the figure.
    """
    names = [name for name in ("oldest_first", "generalist", "beam") if name in table]
    cells = table.groupby(["powered", "connected"], sort=False)[[*names, "bound"]].mean().reset_index()
    figure = new_figure(3.6 * len(names) + 0.6, 3.6)
    axes = np.atleast_1d(figure.subplots(1, len(names), sharey=True))
    for axis, name in zip(axes, names, strict=True):
        cells["ratio"] = 100 * cells[name] / cells["bound"]
        grid = cells.pivot(index="powered", columns="connected", values="ratio").sort_index(ascending=False)
        grid = grid[sorted(grid.columns, reverse=True)]
        image = axis.imshow(grid.to_numpy(), vmin=70, vmax=100, cmap="viridis")
        for (row, column), value in np.ndenumerate(grid.to_numpy()):
            axis.text(
                column, row, f"{value:.1f}", ha="center", va="center", color="w" if value < 90 else "k", fontsize=9
            )
        axis.set_xticks(range(grid.shape[1]), grid.columns)
        axis.set_yticks(range(grid.shape[0]), grid.index)
        axis.set_xlabel("devices with communication")
        axis.set_title(f"{display_name(name)}: {grid.to_numpy().mean():.1f} %")
    axes[0].set_ylabel("devices with power")
    figure.colorbar(image, ax=list(axes), label="lifetime, % of the upper bound")
    save(figure, path)


def reliability_figure(bins: pd.DataFrame, path: Path) -> None:
    """Of all forecasts of about some probability, how many came true.

    Args:
        bins: see :class:`experiments.forecast_quality.ForecastQuality`.
        path: of the figure.
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
    """Lifetime on unseen towns against the seconds spent on training, the paper's 11 minutes marked.

    Args:
        curve: ``ppo`` with ``seconds`` and ``slots``; ``dqn`` likewise, of agents trained in their own towns;
            ``lines``: mean slots of what needs no training, by name.
        path: of the figure.
    """
    figure = new_figure(7.2, 4.4)
    axis = figure.subplots()
    axis.plot(curve["ppo"]["seconds"], curve["ppo"]["slots"], "o-", label="generalist, once for all towns")
    if "dqn" in curve:
        axis.plot(curve["dqn"]["seconds"], curve["dqn"]["slots"], "s--", label="the paper's DQN, for each town again")
    for number, (name, slots) in enumerate(curve["lines"].items()):
        axis.axhline(slots, color="0.6", linewidth=0.8)
        side = "top" if number % 2 else "bottom"  # neighbours may be near
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
    """Lifetime against the share of first failures on high-traffic devices, a point for each price.

    Args:
        table: columns ``place``, ``price``, ``lifetime``, ``busy_first``.
        path: of the figure.
    """
    places = list(dict.fromkeys(table["place"]))
    figure = new_figure(3.6 * len(places), 3.6)
    axes = np.atleast_1d(figure.subplots(1, len(places)))
    for axis, place in zip(axes, places, strict=True):
        own = table[table["place"] == place]
        axis.plot(100 * own["busy_first"], own["lifetime"], "o-")
        for _, row in own.iterrows():
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

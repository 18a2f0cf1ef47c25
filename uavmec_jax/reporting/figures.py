"""Figures, from result files only."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uavmec_jax.reporting.tables import is_grid
from uavmec_jax.studies.paper import TABLE5
from uavmec_jax.studies.results import Results

PANELS = (("best", "DQN, best weights"), ("last", "DQN, last weights"), ("oldest_first", "oldest data first"))
LADDER = {
    "oldest_first_planned": "oldest data first",
    "earliest_deadline_planned": "earliest deadline",
    "best_planned": "DQN, best weights",
    "rollout_planned": "rollout planner",
    "beam_planned": "clairvoyant beam",
    "bound_planned": "upper bound",
}
"""From what anyone would do to what nobody can pass."""


def run_figure(results: Results) -> Figure:
    """The figure of a run: the grids of a power x comms study, else its training curves."""
    if is_grid(results):
        return grid_figure(results) if results.curves else ladder_figure(results)
    return curves_figure(results) if results.curves else ladder_figure(results)


def save(figure: Figure, path: Path) -> None:
    """Write a figure, whole or not at all; the ending says the format."""
    partial = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        figure.savefig(partial, dpi=144, metadata={"Software": None} if path.suffix == ".png" else None)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def new_figure(width: float, height: float) -> Figure:
    """An empty figure that needs no display."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def grid_figure(results: Results) -> Figure:
    """Lifetimes over power x comms as heat maps: ours (best, last), the paper's, oldest-first."""
    cells = results.cells()
    panels = [(name, title) for name, title in PANELS if name in cells]
    figure = new_figure(3.3 * (len(panels) + 1), 3.6)
    axes = figure.subplots(1, len(panels) + 1, sharey=True, squeeze=False)[0]
    paper = cells.assign(
        paper=[TABLE5.get((p, c), np.nan) for p, c in zip(cells.powered, cells.connected, strict=True)]
    )
    limits = (10.0, max(33.0, float(cells[[name for name, _ in panels]].max().max())))
    for axis, (name, title) in zip(axes, [*panels, ("paper", "the paper, Table 5")], strict=True):
        image = _heat_map(axis, paper.pivot(index="powered", columns="connected", values=name), limits)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("connected devices")
    axes[0].set_ylabel("powered devices")
    figure.colorbar(image, ax=axes, label="lifetime, slots", shrink=0.8)
    seeds = int(cells["seeds"].min())
    figure.suptitle(
        f"{results.study.name}: {len(cells)} cells x {seeds} seeds, {results.study.steps:,} steps each", fontsize=11
    )
    return figure


def ladder_figure(results: Results) -> Figure:
    """Lifetimes on the planners' draws, from the heuristics up to the bound: heat maps of a grid, else bars."""
    cells = results.cells()
    panels = [(name, title) for name, title in LADDER.items() if name in cells]
    scenarios = f"{len(cells)} cells x {int(cells['seeds'].min())} layouts"
    if not is_grid(results):
        figure = new_figure(7, 3.6)
        axis = figure.subplots()
        axis.barh([title for _, title in panels], [cells[name].mean() for name, _ in panels])
        axis.set_xlabel("lifetime, slots")
    else:
        figure = new_figure(3.3 * len(panels), 3.6)
        axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axis, (name, title) in zip(axes, panels, strict=True):
            table = cells.pivot(index="powered", columns="connected", values=name)
            image = _heat_map(axis, table, (10.0, max(33.0, float(cells[[name for name, _ in panels]].max().max()))))
            axis.set_title(f"{title}: {cells[name].mean():.1f}", fontsize=10)
            axis.set_xlabel("connected devices")
        axes[0].set_ylabel("powered devices")
        figure.colorbar(image, ax=axes, label="lifetime, slots", shrink=0.8)
    figure.suptitle(f"{results.study.name}: {scenarios}", fontsize=11)
    return figure


def _heat_map(axis: Axes, table: pd.DataFrame, limits: tuple[float, float]) -> mpl.image.AxesImage:
    table = table.sort_index(ascending=False).sort_index(axis=1, ascending=False)
    image = axis.imshow(table.to_numpy(), vmin=limits[0], vmax=limits[1], cmap="viridis")
    axis.set_xticks(range(table.shape[1]), [str(name) for name in table.columns])
    axis.set_yticks(range(table.shape[0]), [str(name) for name in table.index])
    middle = (limits[0] + limits[1]) / 2
    for (row, column), value in np.ndenumerate(table.to_numpy()):
        if np.isfinite(value):
            colour = "white" if value < middle else "black"
            axis.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=9, color=colour)
    return image


def curves_figure(results: Results) -> Figure:
    """Training curves: episode length while exploring, and the greedy policy on validation draws, for every agent."""
    figure = new_figure(9, 3.6)
    left, right = figure.subplots(1, 2, sharey=True)
    pairs = (
        (left, "chunk_steps", "episode_length", "while training"),
        (right, "look_steps", "validation", "greedy policy"),
    )
    for axis, steps, values, title in pairs:
        axis.plot(results.curves[steps], results.curves[values].T, lw=0.6, alpha=0.35, color="tab:blue")
        axis.plot(results.curves[steps], np.nanmean(results.curves[values], axis=0), lw=2, color="tab:orange")
        axis.set_xlabel("environment steps of one agent")
        axis.set_title(f"{title}: every agent, and their mean", fontsize=10)
        axis.grid(alpha=0.3)
    left.set_ylabel("episode length, slots")
    figure.suptitle(f"{results.study.name}: {len(results.agents)} agents", fontsize=11)
    return figure

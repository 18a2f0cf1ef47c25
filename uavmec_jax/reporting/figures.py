"""Figures, from result files only."""

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uavmec_jax.reporting.canvas import new_figure
from uavmec_jax.reporting.table6 import is_table6, label_rewards
from uavmec_jax.reporting.table7_figure import table7_figure
from uavmec_jax.reporting.tables import is_grid
from uavmec_jax.studies.first_failures import has_places
from uavmec_jax.studies.paper import TABLE5
from uavmec_jax.studies.results import Results

PANELS = (("best", "best weights"), ("last", "last weights"), ("oldest_first", "oldest data first"))
LADDER = {
    "oldest_first": "oldest data first",
    "earliest_deadline": "earliest deadline",
    "rollout": "rollout planner",
    "beam": "clairvoyant beam",
    "bound": "upper bound",
}
"""From what anyone would do to what nobody can pass."""


def run_figure(results: Results) -> Figure:
    """The figure of a run: maps and first failures of places; grids of power x comms; lifetimes, if nothing was trained;
    else training curves.
    """
    if has_places(results):
        return table7_figure(results)
    if not results.curves:
        return ladder_figure(results)
    if is_table6(results):
        return table6_figure(results)
    return grid_figure(results) if is_grid(results) else curves_figure(results)


def grid_figure(results: Results) -> Figure:
    """Lifetimes over power x comms as heat maps: ours (best, last), the paper's, oldest-first."""
    cells = results.cells()
    learner = results.study.algorithm.upper()
    panels = [(name, f"{learner}, {title}" if "weights" in title else title) for name, title in PANELS if name in cells]
    paper = [TABLE5.get((p, c), np.nan) for p, c in zip(cells.powered, cells.connected, strict=True)]
    seeds = int(cells["seeds"].min())
    return _grids(
        cells.assign(paper=paper),
        [*panels, ("paper", "the paper, Table 5")],
        float(cells[[name for name, _ in panels]].max().max()),
        f"{results.study.name}: {len(cells)} cells x {seeds} seeds, {results.study.steps:,} steps each",
    )


def ladder_figure(results: Results) -> Figure:
    """Lifetimes from the heuristics up to the bound, on the planners' draws if there are any: heat maps, or bars."""
    cells = results.cells()
    names = [name for name in LADDER if name in cells or f"{name}_planned" in cells] or results.policies
    panels = [(f"{name}_planned" if f"{name}_planned" in cells else name, LADDER.get(name, name)) for name in names]
    title = f"{results.study.name}: {len(cells)} cells x {int(cells['seeds'].min())} layouts"
    if is_grid(results):
        titled = [(name, f"{words}: {cells[name].mean():.1f}") for name, words in panels]
        return _grids(cells, titled, float(cells[[name for name, _ in panels]].max().max()), title)
    figure = new_figure(7, 3.6)
    axis = figure.subplots()
    axis.barh([words for _, words in panels], [cells[name].mean() for name, _ in panels])
    axis.set_xlabel("lifetime, slots")
    figure.suptitle(title, fontsize=11)
    return figure


def _grids(cells: pd.DataFrame, panels: list[tuple[str, str]], longest: float, title: str) -> Figure:
    """Heat maps over power x comms side by side, one per column of ``cells`` and its title, on one scale."""
    figure = new_figure(3.3 * len(panels), 3.6)
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axis, (name, words) in zip(axes, panels, strict=True):
        table = cells.pivot(index="powered", columns="connected", values=name)
        table = table.sort_index(ascending=False).sort_index(axis=1, ascending=False)
        image = _heat_map(axis, table, (10.0, max(33.0, longest)))
        axis.set_title(words, fontsize=10)
        axis.set_xlabel("connected devices")
    axes[0].set_ylabel("powered devices")
    figure.colorbar(image, ax=axes, label="lifetime, slots", shrink=0.8)
    figure.suptitle(title, fontsize=11)
    return figure


def _heat_map(axis: Axes, table: pd.DataFrame, limits: tuple[float, float]) -> mpl.image.AxesImage:
    image = axis.imshow(table.to_numpy(), vmin=limits[0], vmax=limits[1], cmap="viridis")
    axis.set_xticks(range(table.shape[1]), [str(name) for name in table.columns])
    axis.set_yticks(range(table.shape[0]), [str(name) for name in table.index])
    middle = (limits[0] + limits[1]) / 2
    for (row, column), value in np.ndenumerate(table.to_numpy()):
        if np.isfinite(value):
            colour = "white" if value < middle else "black"
            axis.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=9, color=colour)
    return image


def table6_figure(results: Results) -> Figure:
    """Rewards against algorithms and cells, one heat map per log guard: mean lifetime of the best weights."""
    cells = results.cells()
    cells["reward"] = label_rewards(cells)
    cells["column"] = [
        f"{name.upper()}\n{powered}/{connected}"
        for name, powered, connected in zip(cells.algorithm, cells.powered, cells.connected, strict=True)
    ]
    rows, columns = list(dict.fromkeys(cells["reward"])), cells.drop_duplicates("column")
    places = columns.groupby(["powered", "connected"], sort=False)["column"]
    order = [column for _, own in places for column in own]
    table = cells.pivot(index="reward", columns="column", values="best").loc[rows, order]
    figure = new_figure(3.2 + 0.75 * len(order), 1.2 + 0.33 * len(rows))
    axis = figure.subplots()
    image = _heat_map(axis, table, (10.0, max(33.0, float(cells["best"].max()))))
    axis.set_aspect("auto")
    figure.colorbar(image, ax=axis, label="lifetime, slots", shrink=0.8)
    seeds = int(cells["seeds"].min())
    axis.set_title(
        f"{results.study.name}: best weights, mean over {seeds} seeds; columns: powered/connected", fontsize=10
    )
    return figure


def curves_figure(results: Results) -> Figure:
    """Training curves: episode length while exploring, and the greedy policy on validation draws, for every agent."""
    figure = new_figure(9, 3.6)
    left, right = figure.subplots(1, 2, sharey=True)
    pairs = (
        (left, "chunk_steps", "episode_length", "while training"),
        (right, "validation_steps", "validation", "greedy policy"),
    )
    alone = len(results.curves) == 1
    for axis, steps, values, title in pairs:
        for k, (algorithm, curves) in enumerate(results.curves.items()):
            x, y = curves[steps], curves[values]
            axis.plot(x, y.T, lw=0.6, alpha=0.35 if alone else 0.15, color=f"C{2 * k}")
            axis.plot(x, np.nanmean(y, axis=0), lw=2, color=f"C{2 * k + 1}", label=f"{algorithm.upper()}, mean")
        axis.set_xlabel("environment steps of one agent")
        axis.set_title(f"{title}: every agent, and their mean", fontsize=10)
        axis.grid(alpha=0.3)
    right.legend()
    left.set_ylabel("episode length, slots")
    figure.suptitle(f"{results.study.name}: {len(results.agents)} agents", fontsize=11)
    return figure

"""Figures of runs, from result files alone."""

import numpy as np
from matplotlib.figure import Figure

from uavmec_jax.reporting.canvas import PALETTE, legend_beside, line_style, literal, new_figure
from uavmec_jax.reporting.formatting import slots
from uavmec_jax.reporting.heat_map import draw_heat_map, heat_map_figure
from uavmec_jax.reporting.table6 import is_table6, label_rewards
from uavmec_jax.reporting.table7_figure import table7_figure
from uavmec_jax.reporting.tables import by_fleet, is_grid
from uavmec_jax.studies.first_failures import has_places
from uavmec_jax.studies.measures import mostly_censored
from uavmec_jax.studies.paper import TABLE5
from uavmec_jax.studies.results import Results

_PANELS = (("best", "best weights"), ("last", "last weights"), ("oldest_first", "oldest data first"))
_LADDER = {
    "oldest_first": "oldest data first",
    "earliest_deadline": "earliest deadline",
    "rollout": "rollout planner",
    "beam": "clairvoyant beam",
    "bound": "upper bound",
}
"""Policies from the simplest heuristic up to the upper bound -> their titles."""


def run_figure(results: Results) -> Figure:
    """Return the figure that fits a run.

    A study of places has its maps and first failures, one that trained nothing its lifetimes, and one like Table 5 or 6 heat
    maps; others have training curves.
    """
    if has_places(results):
        return table7_figure(results)
    if not results.curves:
        return ladder_figure(results)
    if is_table6(results):
        return table6_figure(results)
    return grid_figure(results) if is_grid(results) else curves_figure(results)


def _lifetime_limits(longest: float) -> tuple[float, float]:
    """Return the limits of the colour scale for lifetimes in slots: the same for most runs, so that they compare."""
    return 10.0, max(33.0, longest)


def grid_figure(results: Results) -> Figure:
    """Return heat maps of lifetimes over powered x connected devices: ours (best, last), oldest-first, the paper's."""
    cells = results.cells()
    algorithm = results.study.algorithm.upper()
    panels = [
        (name, f"{algorithm}, {title}" if "weights" in title else title) for name, title in _PANELS if name in cells
    ]
    longest = float(cells[[name for name, _ in panels]].max().max())
    paper = [TABLE5.get((p, c), np.nan) for p, c in zip(cells.powered, cells.connected, strict=True)]
    cells, panels = cells.assign(paper=paper), [*panels, ("paper", "the paper, Table 5")]
    figure = heat_map_figure([(cells, panels)], _lifetime_limits(longest), "lifetime, slots")
    seeds, steps = int(cells["seeds"].min()), results.study.steps
    figure.suptitle(
        f"{literal(results.study.name)}: {len(cells)} cells x {seeds} seeds, {steps:,} steps each", fontsize=11
    )
    return figure


def ladder_figure(results: Results) -> Figure:
    """Return lifetimes from the heuristics up to the upper bound as heat maps, or as bars where there is no grid.

    They are those on the planners' draws, if there are any. Each fleet has a row of heat maps. Means over cells are without
    those that are mostly censored.
    """
    cells = results.cells()
    names = [name for name in _LADDER if name in cells or f"{name}_planned" in cells] or results.policies
    panels = [(f"{name}_planned" if f"{name}_planned" in cells else name, _LADDER.get(name, name)) for name in names]
    fleets = by_fleet(results)
    if all(map(is_grid, fleets.values())):
        longest = float(cells[[name for name, _ in panels]].max().max())
        rows = []
        for start, fleet in fleets.items():
            of_fleet = fleet.cells()
            kept = of_fleet[~mostly_censored(of_fleet, names)]
            titled = [(name, f"{start}{title}: {slots(kept[name].mean())}") for name, title in panels]
            rows.append((of_fleet, titled))
        figure = heat_map_figure(rows, _lifetime_limits(longest), "lifetime, slots")
    else:
        figure = new_figure(7, 3.6)
        axis = figure.subplots()
        kept = cells[~mostly_censored(cells, names)]
        axis.barh([literal(title) for _, title in panels], [kept[name].mean() for name, _ in panels])
        axis.set_xlabel("lifetime, slots")
    layouts = int(cells["seeds"].min())
    figure.suptitle(f"{literal(results.study.name)}: {len(cells)} cells x {layouts} layouts", fontsize=11)
    return figure


def table6_figure(results: Results) -> Figure:
    """Return a heat map of rewards by algorithms and cells: mean lifetime of the best weights."""
    cells = results.cells()
    cells["reward"] = label_rewards(cells)
    cells["column"] = [
        f"{name.upper()}\n{powered}/{connected}"
        for name, powered, connected in zip(cells.algorithm, cells.powered, cells.connected, strict=True)
    ]
    rows, columns = list(dict.fromkeys(cells["reward"])), cells.drop_duplicates("column")
    groups = columns.groupby(["powered", "connected"], sort=False)["column"]
    order = [column for _, group in groups for column in group]
    table = cells.pivot(index="reward", columns="column", values="best").loc[rows, order]
    figure = new_figure(3.2 + 0.75 * len(order), 1.2 + 0.33 * len(rows))
    axis = figure.subplots()
    image = draw_heat_map(axis, table, _lifetime_limits(float(cells["best"].max())))
    axis.set_aspect("auto")
    figure.colorbar(image, ax=axis, label="lifetime, slots", shrink=0.8)
    seeds = int(cells["seeds"].min())
    axis.set_title(
        f"{literal(results.study.name)}: best weights, mean over {seeds} seeds; columns: powered/connected", fontsize=10
    )
    return figure


def curves_figure(results: Results) -> Figure:
    """Return the training curves of every agent: episode length while exploring, and validation of the greedy policy."""
    figure = new_figure(9, 3.6)
    left, right = figure.subplots(1, 2, sharey=True)
    pairs = (
        (left, "chunk_steps", "episode_length", "while training"),
        (right, "validation_steps", "validation", "greedy policy"),
    )
    single = len(results.curves) == 1
    for axis, steps, values, title in pairs:
        for k, (algorithm, curves) in enumerate(results.curves.items()):
            x, y = curves[steps], curves[values]
            axis.plot(x, y.T, lw=0.6, alpha=0.35 if single else 0.15, color=PALETTE[k % len(PALETTE)])
            mean = line_style(k) | ({"color": "black"} if single else {})
            axis.plot(x, np.nanmean(y, axis=0), lw=2, label=f"{algorithm.upper()}, mean", **mean)
        axis.set_xlabel("environment steps of one agent")
        axis.set_title(f"{title}: every agent, and their mean", fontsize=10)
        axis.grid(alpha=0.3)
    legend_beside(right)
    left.set_ylabel("episode length, slots")
    figure.suptitle(f"{literal(results.study.name)}: {len(results.agents)} agents", fontsize=11)
    return figure

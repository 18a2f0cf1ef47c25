"""The figure of a study of places: each road map, and beside it the first failures of its devices."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uavmec_jax.errors import TrafficError
from uavmec_jax.reporting.canvas import PALETTE, legend_beside, literal, new_figure
from uavmec_jax.reporting.road_map import draw_map
from uavmec_jax.reporting.table7 import count_columns
from uavmec_jax.studies.first_failures import first_failure_groups
from uavmec_jax.studies.paper import TABLE7
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.schema import PLANNERS
from uavmec_jax.traffic.evacuation import load_evacuation

_MAX_ROWS = 8


def table7_figure(results: Results) -> Figure:
    """Return a row for each place (and cell): its map, if its file still exists, and its first failures."""
    groups = dict(list(first_failure_groups(results).items())[:_MAX_ROWS])
    figure = new_figure(14, 5.4 * len(groups))
    axes = figure.subplots(len(groups), 2, squeeze=False, width_ratios=(1, 1.3))
    for (left, right), (name, counts) in zip(axes, groups.items(), strict=True):
        try:
            draw_map(left, load_evacuation(str(counts["place"].iloc[0])))
        except TrafficError as error:
            left.text(0.5, 0.5, literal(f"no map: {error}"), ha="center", va="center", wrap=True, fontsize=8)
            left.set_axis_off()
        _draw_failures(right, counts, name)
    seeds = results.agents["seed"].nunique()
    figure.suptitle(f"{literal(results.study.name)}: {seeds} scenarios, {results.study.steps:,} steps", fontsize=11)
    return figure


def _draw_failures(axis: Axes, counts: pd.DataFrame, name: str) -> None:
    """Draw the first failures of each device, one bar per policy; devices in high traffic are shaded."""
    drawn = counts[~counts["policy"].isin(PLANNERS)]  # with the planners, the bars would be too thin to tell apart
    columns = {policy: rows["count"].to_numpy() for policy, rows in count_columns(drawn).items()}
    place = str(counts["place"].iloc[0])
    if place in TABLE7:
        columns["paper"] = np.array(TABLE7[place], float)
    devices = counts.drop_duplicates("device")
    numbers = devices["device"].to_numpy()
    width = 0.8 / len(columns)
    for k, (policy, values) in enumerate(columns.items()):
        colour = "black" if policy == "paper" else PALETTE[k % len(PALETTE)]
        axis.bar(numbers + (k - (len(columns) - 1) / 2) * width, values, width, label=literal(policy), color=colour)
    for number in numbers[devices["high_traffic"].to_numpy()]:
        axis.axvspan(number - 0.5, number + 0.5, color="lightgrey", alpha=0.5, zorder=0, lw=0)
    axis.set_xticks(numbers)
    axis.set_xlim(0.5, len(numbers) + 0.5)
    axis.set_xlabel("device; shaded: in high traffic")
    axis.set_ylabel("first failures")
    legend_beside(axis)
    axis.set_title(f"{literal(name)}: first failures", fontsize=10)

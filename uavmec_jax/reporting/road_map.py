"""Road maps: roads coloured by traffic density in seven steps, devices numbered and sized by weight."""

from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from uavmec_jax.reporting.canvas import legend_beside, literal, new_figure
from uavmec_jax.traffic.evacuation import Evacuation

COLOURS = tuple(to_hex(matplotlib.colormaps["plasma_r"](share)) for share in np.linspace(0.1, 1.0, 7))
"""Colours in order of increasing density, from light to dark: also in grey, and with any colour vision, denser is darker.

The paper's figure 4 has seven colours, too, in the order of the rainbow.
"""

LIMITS = (2.0, 5.0, 10.0, 20.0, 35.0, 60.0)
"""Vehicles per km and lane between one colour and the next; the paper gives none."""

_THIN, _THICK = 0.9, 2.4
"""Widths of roads below the first limit, and of all others, points."""

_MARGIN = 0.35
"""Margin of the map around the devices, as a share of the longer side of their bounding box."""


def colours_of(density: Float[np.ndarray, " R"]) -> list[str]:
    """Return the colour of each density, in vehicles per km and lane."""
    return [COLOURS[k] for k in np.searchsorted(LIMITS, density, side="right")]


def draw_roads(axis: Axes, evacuation: Evacuation, density: Float[np.ndarray, " R"]) -> LineCollection:
    """Draw the roads, the densest on top; the origin is the corner where the UAV starts.

    Args:
        axis: to draw on.
        evacuation: its roads are drawn.
        density: ``[R]`` vehicles per km and lane.
    """
    corner = evacuation.position.min(axis=0)
    order = np.argsort(density)
    roads = evacuation.roads
    widths = np.where(density[order] < LIMITS[0], _THIN, _THICK)
    lines = LineCollection(
        [roads[k] - corner for k in order], colors=colours_of(density[order]), linewidths=widths, zorder=1
    )
    axis.add_collection(lines)
    return lines


def draw_sites(axis: Axes, evacuation: Evacuation) -> None:
    """Draw the devices as numbered discs, larger where there is more traffic."""
    position = evacuation.local_position()
    sizes = 120 + 420 * evacuation.weight
    axis.scatter(position[:, 0], position[:, 1], s=sizes, color="white", edgecolor="black", linewidth=1.2, zorder=3)
    for number, (x, y) in enumerate(position, 1):
        axis.annotate(f"{number}", (x, y), ha="center", va="center", fontsize=8, zorder=4)


def set_limits(axis: Axes, evacuation: Evacuation) -> None:
    """Set equal scales, and limits around the devices."""
    side = max(evacuation.region_m())
    low = evacuation.local_position().max(axis=0) / 2 - side * (0.5 + _MARGIN / 2)
    axis.set_xlim(low[0], low[0] + side * (1 + _MARGIN))
    axis.set_ylim(low[1], low[1] + side * (1 + _MARGIN))
    axis.set_aspect("equal")
    axis.set_xlabel("m east of the start")
    axis.set_ylabel("m north of the start")


def density_legend() -> list[Line2D]:
    """Return the entries of a legend of the roads and the devices."""
    edges = [0.0, *LIMITS]
    labels = [f"{low:g} to {high:g}" for low, high in zip(edges, LIMITS, strict=False)] + [f"above {LIMITS[-1]:g}"]
    widths = [_THIN, *[_THICK] * (len(COLOURS) - 1)]
    roads = [
        Line2D([], [], color=colour, lw=width, label=label)
        for colour, width, label in zip(COLOURS, widths, labels, strict=True)
    ]
    device: Any = {"marker": "o", "mfc": "white", "mec": "black", "ls": ""}
    little = Line2D([], [], ms=6, label="device, little traffic", **device)
    return [*roads, little, Line2D([], [], ms=12, label="device, much traffic", **device)]


def draw_map(axis: Axes, evacuation: Evacuation) -> None:
    """Draw the complete map: roads by their mean density, devices, legend."""
    draw_roads(axis, evacuation, evacuation.mean_road_density)
    draw_sites(axis, evacuation)
    set_limits(axis, evacuation)
    first, last = evacuation.meta["mean_s"]
    legend_beside(axis, handles=density_legend(), title="vehicles/km/lane", title_fontsize=7)
    axis.set_title(f"{literal(evacuation.name)}: mean of {first / 60:.0f} to {last / 60:.0f} min", fontsize=10)


def map_figure(evacuation: Evacuation) -> Figure:
    """Return the road map of an evacuation, with the description of the place below it."""
    figure = new_figure(8.6, 6.4)
    draw_map(figure.subplots(), evacuation)
    figure.supxlabel(literal(evacuation.meta["description"]), fontsize=7)
    return figure

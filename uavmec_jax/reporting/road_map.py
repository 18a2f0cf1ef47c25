"""Road maps: roads coloured by traffic density in the paper's seven colours, devices numbered and sized by weight."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from uavmec_jax.reporting.canvas import new_figure
from uavmec_jax.traffic.evacuation import Evacuation

COLOURS = ("blue", "cyan", "yellow", "green", "orange", "red", "magenta")
"""In order of increasing density (paper, figure 4)."""

LIMITS = (2.0, 5.0, 10.0, 20.0, 35.0, 60.0)
"""Vehicles per km and lane between one colour and the next; the paper gives none."""

_BESIDE = 0.35
"""How much of the map around the devices is shown, in parts of what they span."""


def colour_of(density: np.ndarray) -> list[str]:
    """A colour for each density, vehicles per km and lane."""
    return [COLOURS[k] for k in np.searchsorted(LIMITS, density, side="right")]


def draw_roads(axis: Axes, evacuation: Evacuation, density: np.ndarray) -> LineCollection:
    """Roads in metres from the corner where the UAV starts.

    Args:
        axis: to draw on.
        evacuation: whose roads.
        density: ``[R]`` vehicles per km and lane.
    """
    corner = evacuation.position.min(axis=0)
    order = np.argsort(density)  # the densest on top
    roads = evacuation.roads
    colours = colour_of(density[order])
    widths = np.where(density[order] < LIMITS[0], 0.8, 2.2)
    lines = LineCollection([roads[k] - corner for k in order], colors=colours, linewidths=widths, zorder=1)
    axis.add_collection(lines)
    return lines


def draw_sites(axis: Axes, evacuation: Evacuation) -> None:
    """Numbered discs; the larger, the more traffic."""
    position = evacuation.local_position()
    sizes = 120 + 420 * evacuation.weight
    axis.scatter(position[:, 0], position[:, 1], s=sizes, color="white", edgecolor="black", linewidth=1.2, zorder=3)
    for number, (x, y) in enumerate(position, 1):
        axis.annotate(f"{number}", (x, y), ha="center", va="center", fontsize=8, zorder=4)


def frame(axis: Axes, evacuation: Evacuation) -> None:
    """Limits around the devices, equal scales."""
    side = max(evacuation.region_m())
    low = evacuation.local_position().max(axis=0) / 2 - side * (0.5 + _BESIDE / 2)
    axis.set_xlim(low[0], low[0] + side * (1 + _BESIDE))
    axis.set_ylim(low[1], low[1] + side * (1 + _BESIDE))
    axis.set_aspect("equal")
    axis.set_xlabel("m east of the start")
    axis.set_ylabel("m north of the start")


def density_key() -> list[Line2D]:
    """Entries of a legend: what the colours say."""
    edges = [0.0, *LIMITS]
    words = [f"{low:g} to {high:g}" for low, high in zip(edges, LIMITS, strict=False)] + [f"above {LIMITS[-1]:g}"]
    return [Line2D([], [], color=colour, lw=2.5, label=word) for colour, word in zip(COLOURS, words, strict=True)]


def draw_map(axis: Axes, evacuation: Evacuation) -> None:
    """The atomic map: roads by their mean density, devices, key."""
    draw_roads(axis, evacuation, evacuation.mean_road_density)
    draw_sites(axis, evacuation)
    frame(axis, evacuation)
    first, last = evacuation.meta["mean_s"]
    axis.legend(
        handles=density_key(),
        fontsize=7,
        loc="upper left",
        bbox_to_anchor=(1, 1),
        title="vehicles/km/lane",
        title_fontsize=7,
    )
    axis.set_title(f"{evacuation.name}: mean of {first / 60:.0f} to {last / 60:.0f} min", fontsize=10)


def map_figure(evacuation: Evacuation) -> Figure:
    """The road map of an evacuation, with what it is and what it is not."""
    figure = new_figure(7.4, 6.4)
    draw_map(figure.subplots(), evacuation)
    figure.supxlabel(evacuation.meta["description"], fontsize=7)
    return figure

"""One evacuation slot by slot as an animated GIF: traffic, the tours of the UAVs, batteries, data ages."""

from pathlib import Path

import jax
import numpy as np
from jaxtyping import Bool, Float, Num, PRNGKeyArray
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uavmec_jax.env.layout import Layout, fleet_of
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy, Trace, trace
from uavmec_jax.files.writing import atomic
from uavmec_jax.reporting.canvas import literal, new_figure
from uavmec_jax.reporting.map_figure import uav_colour
from uavmec_jax.reporting.road_map import density_legend, draw_roads, draw_sites, set_limits
from uavmec_jax.traffic.evacuation import Evacuation

_MAX_SLOTS = 120
"""Longest episode that is drawn."""

_FRAMES_PER_S = 2


def save_animation(
    path: Path, evacuation: Evacuation, params: Params, layout: Layout, policy: Policy, key: PRNGKeyArray, title: str
) -> int:
    """Draw an episode of a policy, one frame per slot; return the length of the episode in slots.

    Args:
        path: a ``.gif``, written atomically.
        evacuation: the roads and their densities.
        params: simulation parameters.
        layout: the devices, at the sites of the evacuation.
        policy: chooses the device to visit in each slot.
        key: draws the task volumes.
        title: of the map.
    """
    episode = jax.tree.map(np.asarray, jax.jit(lambda: trace(policy, params, layout, key, _MAX_SLOTS))())
    slots = int(episode.played.sum())
    figure = new_figure(9.6, 6.2)
    writer = PillowWriter(fps=_FRAMES_PER_S)
    with atomic(path) as partial, writer.saving(figure, str(partial), dpi=80):
        for slot in range(slots):
            figure.clear()
            _draw_slot(figure, evacuation, params, layout, episode, slot, title)
            writer.grab_frame()
        for _ in range(2 * _FRAMES_PER_S):  # hold the last frame before the animation repeats
            writer.grab_frame()
    return slots


def _draw_slot(
    figure: Figure, evacuation: Evacuation, params: Params, layout: Layout, episode: Trace, slot: int, title: str
) -> None:
    """Draw the network after a slot: the map, and bars of batteries and data ages."""
    axes = figure.subplots(1, 3, width_ratios=(5, 1.3, 1.3))
    now, age_limit = jax.tree.map(lambda leaf: leaf[slot], episode), float(params.data_age_limit_slots)
    elapsed, failed = float(now.state.elapsed), np.asarray(now.outcome.first_failure)
    window = min(int(elapsed // evacuation.meta["window_s"]), len(evacuation.road_density) - 1)
    start = np.asarray(fleet_of(params, layout).start_m)
    stops = np.concatenate([start[None], episode.state.uav_position[: slot + 1]])
    scale = max(evacuation.region_m()) / max(
        float(np.max(layout.position)), 1.0
    )  # layouts may be scaled copies of a place
    _draw_traffic(axes[0], evacuation, stops * scale, window)
    axes[0].set_title(f"{literal(title)}: slot {slot + 1}, {elapsed / 60:.0f} min after the order", fontsize=10)
    battery = np.asarray(now.state.battery) / np.asarray(layout.capacity)
    _draw_bars(axes[1], battery, np.asarray(layout.has_power), failed, "battery", 1.0)
    _draw_bars(axes[2], np.asarray(now.state.age), np.asarray(layout.has_comms), failed, "age, slots", age_limit + 1)
    axes[2].axvline(age_limit, color="black", lw=0.8, ls=":")


def _draw_traffic(axis: Axes, evacuation: Evacuation, stops: Float[np.ndarray, "stops K 2"], window: int) -> None:
    """Draw the roads with their densities in a window, the devices, and where the UAVs have been, m."""
    draw_roads(axis, evacuation, evacuation.road_density[window])
    draw_sites(axis, evacuation)
    set_limits(axis, evacuation)
    for uav in range(stops.shape[1]):
        tour = stops[:, uav]
        colour = "black" if stops.shape[1] == 1 else uav_colour(uav)
        axis.plot(*tour.T, color=colour, lw=0.6, alpha=0.4, zorder=2)
        axis.plot(*tour[-2:].T, color=colour, lw=1.8, zorder=5)
        axis.plot(*tour[-1], marker="X", color=colour, ms=11, zorder=6)
    axis.legend(handles=density_legend(), fontsize=6, loc="lower right", title="vehicles/km/lane", title_fontsize=6)


def _draw_bars(
    axis: Axes,
    value: Num[np.ndarray, " n"],
    has_resource: Bool[np.ndarray, " n"],
    failed: Float[np.ndarray, " n"],
    title: str,
    limit: float,
) -> None:
    """Draw a bar per device: grey where the device has the resource and needs no visit, red where it failed first."""
    numbers = np.arange(1, len(value) + 1)
    colours = [
        "tab:red" if share > 0 else "lightgrey" if has else "tab:blue"
        for share, has in zip(failed, has_resource, strict=True)
    ]
    axis.barh(numbers, value, color=colours)
    axis.set_yticks(numbers)
    axis.set_ylim(len(value) + 0.6, 0.4)
    axis.set_xlim(0, limit)
    axis.set_title(title, fontsize=9)
    axis.tick_params(labelsize=7)

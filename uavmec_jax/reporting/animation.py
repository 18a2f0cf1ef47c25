"""One evacuation slot by slot as an animated GIF: traffic, the UAV's route, batteries, ages."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy, Trace, trace
from uavmec_jax.files.writing import atomic
from uavmec_jax.reporting.canvas import new_figure
from uavmec_jax.reporting.road_map import density_key, draw_roads, draw_sites, frame
from uavmec_jax.traffic.evacuation import Evacuation

MOST_SLOTS = 120
"""Longest episode that is drawn."""

_FRAMES_PER_S = 2


def save_animation(
    path: Path, evacuation: Evacuation, params: Params, layout: Layout, policy: Policy, key: Any, title: str
) -> int:
    """Draw the episode that a policy plays, a frame for each slot; how many slots it lasted.

    Args:
        path: a ``.gif``; written atomic or not at all.
        evacuation: the roads and their densities.
        params: scenario parameters.
        layout: the devices, where the evacuation has them.
        policy: whom to ask for the next device.
        key: the volume draw.
        title: above the map.
    """
    told = jax.tree.map(np.asarray, jax.jit(lambda: trace(policy, params, layout, key, MOST_SLOTS))())
    slots = int(told.played.sum())
    figure = new_figure(9.6, 6.2)
    writer = PillowWriter(fps=_FRAMES_PER_S)
    with atomic(path) as partial, writer.saving(figure, str(partial), dpi=80):
        for slot in range(slots):
            figure.clear()
            _draw_slot(figure, evacuation, params, layout, told, slot, title)
            writer.grab_frame()
        for _ in range(2 * _FRAMES_PER_S):  # the end stays a while
            writer.grab_frame()
    return slots


def _draw_slot(
    figure: Figure, evacuation: Evacuation, params: Params, layout: Layout, told: Trace, slot: int, title: str
) -> None:
    axes = figure.subplots(1, 3, width_ratios=(5, 1.3, 1.3))
    now, limit = jax.tree.map(lambda leaf: leaf[slot], told), float(params.data_age_limit_slots)
    elapsed, failed = float(now.state.elapsed), np.asarray(now.outcome.first_failure)
    window = min(int(elapsed // evacuation.meta["window_s"]), len(evacuation.road_density) - 1)
    _draw_traffic(axes[0], evacuation, np.asarray(layout.position), told, slot, window)
    axes[0].set_title(f"{title}: slot {slot + 1}, {elapsed / 60:.0f} min after the order", fontsize=10)
    battery = np.asarray(now.state.battery) / np.asarray(layout.capacity)
    _draw_bars(axes[1], battery, np.asarray(layout.has_power), failed, "battery", 1.0)
    _draw_bars(axes[2], np.asarray(now.state.age), np.asarray(layout.has_comms), failed, "age, slots", limit + 1)
    axes[2].axvline(limit, color="black", lw=0.8, ls=":")


def _draw_traffic(
    axis: Axes, evacuation: Evacuation, position: np.ndarray, told: Trace, slot: int, window: int
) -> None:
    draw_roads(axis, evacuation, evacuation.road_density[window])
    draw_sites(axis, evacuation)
    frame(axis, evacuation)
    scale = max(evacuation.region_m()) / max(float(position.max()), 1.0)  # places may be flown over scaled
    route = np.concatenate([np.zeros((1, 2)), position[told.action[: slot + 1]]]) * scale
    axis.plot(*route.T, color="black", lw=0.6, alpha=0.4, zorder=2)
    axis.plot(*route[-2:].T, color="black", lw=1.8, zorder=5)
    axis.plot(*route[-1], marker="X", color="black", ms=11, zorder=6)
    axis.legend(handles=density_key(), fontsize=6, loc="lower right", title="vehicles/km/lane", title_fontsize=6)


def _draw_bars(axis: Axes, value: np.ndarray, has: np.ndarray, failed: np.ndarray, words: str, full: float) -> None:
    """A bar for each device; pale where it has the resource and needs no visit, red where it has failed first."""
    numbers = np.arange(1, len(value) + 1)
    colours = [
        "tab:red" if lost > 0 else "lightgrey" if own else "tab:blue" for lost, own in zip(failed, has, strict=True)
    ]
    axis.barh(numbers, value, color=colours)
    axis.set_yticks(numbers)
    axis.set_ylim(len(value) + 0.6, 0.4)
    axis.set_xlim(0, full)
    axis.set_title(words, fontsize=9)
    axis.tick_params(labelsize=7)

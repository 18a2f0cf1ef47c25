"""One evacuation slot by slot as an animated GIF: traffic, the tours of the UAVs, batteries, data ages."""

from pathlib import Path

import jax
import numpy as np
from jaxtyping import Bool, Float, Num, PRNGKeyArray
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image

from uavmec_jax.env.layout import Layout, fleet_of
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy, Trace, trace
from uavmec_jax.files.writing import atomic
from uavmec_jax.reporting.canvas import literal, new_figure, pixels
from uavmec_jax.reporting.map_figure import uav_colour
from uavmec_jax.reporting.road_map import COLOURS, density_legend, draw_roads, draw_sites, set_limits
from uavmec_jax.traffic.evacuation import Evacuation

_MAX_SLOTS = 120
"""Longest episode that is drawn."""

_LEGEND = "roads: vehicles/km/lane; cross: UAV, with its tour; dotted: the limit of ages"

_FRAME_MS, _LAST_FRAME_MS = 500, 2500
"""How long frames are shown; the last one longer, before the animation repeats."""

_HAS, _LACKS, _FAILED = "#D0D0D0", "#0072B2", "#D55E00"
"""Colours of the bars of devices that have a resource, that lack it, and that failed."""

_HATCH = "///"
"""What also marks the bars of devices that failed."""


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
    figure, palette, frames = new_figure(9.6, 6.6), _palette(layout.n_uavs), []
    figure.set_dpi(80)
    for slot in range(slots):
        figure.clear()
        _draw_slot(figure, evacuation, params, layout, episode, slot, title)
        frames.append(Image.fromarray(pixels(figure)).quantize(palette=palette, dither=Image.Dither.NONE))
    durations = [_FRAME_MS] * (slots - 1) + [_LAST_FRAME_MS]
    with atomic(path) as partial:
        frames[0].save(
            partial, "GIF", save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=False
        )
    return slots


def _palette(n_uavs: int) -> Image.Image:
    """Return the palette of all frames: the colours that are drawn, and what is between them and white at smooth edges."""
    drawn = [*COLOURS, _HAS, _LACKS, _FAILED, *map(uav_colour, range(min(n_uavs, 8)))]
    shares = np.linspace(0.0, 1.0, 9)[:-1]  # of white
    mixed = [share + (1 - share) * np.array(to_rgb(colour)) for colour in drawn for share in shares]
    greys = [np.full(3, level) for level in np.linspace(0.0, 1.0, 256 - len(mixed))]
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.round(255 * np.array(mixed + greys)).astype(np.uint8).tobytes())
    return palette


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
    bars = [Patch(color=_LACKS, label="lacks power, or communication"), Patch(color=_HAS, label="has it")]
    bars.append(Patch(facecolor=_FAILED, hatch=_HATCH, label="failed first"))
    figure.legend(
        handles=[*density_legend(), *bars],
        loc="outside lower center",
        ncols=6,
        fontsize=7,
        title=_LEGEND,
        title_fontsize=7,
    )


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


def _draw_bars(
    axis: Axes,
    value: Num[np.ndarray, " n"],
    has_resource: Bool[np.ndarray, " n"],
    failed: Float[np.ndarray, " n"],
    title: str,
    limit: float,
) -> None:
    """Draw a bar per device, in a colour for whether it has the resource, or failed first."""
    numbers = np.arange(1, len(value) + 1)
    colours = [
        _FAILED if share > 0 else _HAS if has else _LACKS for share, has in zip(failed, has_resource, strict=True)
    ]
    for bar, share in zip(axis.barh(numbers, value, color=colours), failed, strict=True):
        bar.set_hatch(_HATCH if share > 0 else "")
    axis.set_yticks(numbers)
    axis.set_ylim(len(value) + 0.6, 0.4)
    axis.set_xlim(0, limit)
    axis.set_title(title, fontsize=9)
    axis.tick_params(labelsize=7)

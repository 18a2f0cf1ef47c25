"""Maps: the devices of a layout by what they lack, and one moment of an episode as pixels."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.scenario import Scenario

_COLOURS = {
    (True, True): "tab:green",
    (True, False): "tab:blue",
    (False, True): "tab:orange",
    (False, False): "tab:red",
}
_LACKS = {
    (True, True): "has both",
    (True, False): "no comms",
    (False, True): "no power",
    (False, False): "has neither",
}


def draw_devices(axis: Axes, layout: Layout) -> None:
    """Numbered discs, one colour for each combination of power and communication; a legend entry for each."""
    for (power, comms), colour in _COLOURS.items():
        these = (np.asarray(layout.has_power) == power) & (np.asarray(layout.has_comms) == comms)
        x, y = np.asarray(layout.position)[these].T
        axis.scatter(x, y, s=90, color=colour, label=_LACKS[power, comms], zorder=2)
    for device, (x, y) in enumerate(np.asarray(layout.position)):
        axis.annotate(f"{device + 1}", (x, y), ha="center", va="center", fontsize=7, color="white", zorder=3)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("m east")
    axis.set_ylabel("m north")


def map_pixels(scenario: Scenario, state: State, visited: int | None = None) -> np.ndarray:
    """One moment of an episode, ``[480, 640, 3]`` uint8.

    Args:
        scenario: whose devices.
        state: batteries (share under each device that lacks power), ages (above each that lacks communication), UAV.
        visited: the device just visited, ringed.
    """
    figure = Figure(figsize=(6.4, 4.8), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axis, layout = figure.subplots(), scenario.layout
    draw_devices(axis, layout)
    share = np.asarray(state.battery) / np.asarray(layout.capacity)
    for device, place in enumerate(np.asarray(layout.position)):
        says = [] if layout.has_power[device] else [f"{share[device]:.0%}"]
        says += [] if layout.has_comms[device] else [f"age {int(state.age[device])}"]
        axis.annotate(", ".join(says), place, xytext=(0, -14), textcoords="offset points", ha="center", fontsize=7)
    x, y = np.asarray(state.uav_position)
    axis.plot(x, y, marker="X", color="black", ls="", ms=9, alpha=0.7, label="UAV", zorder=4)
    if visited is not None:
        axis.plot(x, y, marker="o", mfc="none", mec="black", ls="", ms=18, zorder=4)
    axis.set_title(f"slot {int(state.slot)}, UAV {float(state.uav_energy) / 1000:.0f} kJ", fontsize=10)
    axis.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1, 1))
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()

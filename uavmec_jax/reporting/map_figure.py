"""Maps: the devices of a layout by the resources they have, and the state of an episode as pixels."""

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.scenario import Scenario

_RESOURCES = {
    (True, True): ("tab:green", "has both"),
    (True, False): ("tab:blue", "no comms"),
    (False, True): ("tab:orange", "no power"),
    (False, False): ("tab:red", "has neither"),
}
"""Power and communication of a device -> its colour, and the label of the colour."""


def draw_devices(axis: Axes, layout: Layout) -> None:
    """Draw numbered discs, with a colour and a legend entry for each combination of power and communication."""
    for (power, comms), (colour, label) in _RESOURCES.items():
        chosen = (np.asarray(layout.has_power) == power) & (np.asarray(layout.has_comms) == comms)
        x, y = np.asarray(layout.position)[chosen].T
        axis.scatter(x, y, s=90, color=colour, label=label, zorder=2)
    for device, (x, y) in enumerate(np.asarray(layout.position)):
        axis.annotate(f"{device + 1}", (x, y), ha="center", va="center", fontsize=7, color="white", zorder=3)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("m east")
    axis.set_ylabel("m north")


def map_pixels(scenario: Scenario, state: State, visited: int | None = None) -> UInt8[np.ndarray, "480 640 3"]:
    """Draw a state of an episode.

    Args:
        scenario: its devices are drawn.
        state: batteries (written below each device that lacks power), data ages (where communication is missing), UAV.
        visited: the device just visited, which is ringed.

    Returns:
        Pixels ``[480, 640, 3]``, RGB.
    """
    figure = Figure(figsize=(6.4, 4.8), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axis, layout = figure.subplots(), scenario.layout
    draw_devices(axis, layout)
    fraction = np.asarray(state.battery) / np.asarray(layout.capacity)
    for device, position in enumerate(np.asarray(layout.position)):
        labels = [] if layout.has_power[device] else [f"{fraction[device]:.0%}"]
        labels += [] if layout.has_comms[device] else [f"age {int(state.age[device])}"]
        text = ", ".join(labels)
        axis.annotate(text, position, xytext=(0, -14), textcoords="offset points", ha="center", fontsize=7)
    (x, y), energy = np.asarray(state.uav_position)[0], float(np.asarray(state.uav_energy)[0])
    axis.plot(x, y, marker="X", color="black", ls="", ms=9, alpha=0.7, label="UAV", zorder=4)
    if visited is not None:
        axis.plot(x, y, marker="o", mfc="none", mec="black", ls="", ms=18, zorder=4)
    axis.set_title(f"slot {int(state.slot)}, UAV {energy / 1000:.0f} kJ", fontsize=10)
    axis.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1, 1))
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()

"""Maps: the devices of a layout by the resources they have, and the state of an episode as pixels."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.fleet import DepotKind
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.reporting.canvas import legend_beside, pixels

_RESOURCES = {
    (True, True): ("#595959", "o", 110, "has both"),
    (True, False): ("#0072B2", "p", 150, "no comms"),
    (False, True): ("#C44E00", "D", 95, "no power"),
    (False, False): ("#6A1B7A", "^", 210, "has neither"),
}
"""Power and communication of a device -> its colour, its shape, the area in which a number has room, and the label."""

_MOST_ENERGIES = 5
"""UAVs whose energies are in the title."""


def draw_devices(axis: Axes, layout: Layout) -> None:
    """Draw numbered shapes, one with a colour of its own for each combination of power and communication that there is."""
    for (power, comms), (colour, shape, area, label) in _RESOURCES.items():
        chosen = (np.asarray(layout.has_power) == power) & (np.asarray(layout.has_comms) == comms)
        x, y = np.asarray(layout.position)[chosen].T
        if chosen.any():
            axis.scatter(x, y, s=area, marker=shape, color=colour, label=label, zorder=2)
    for device, (x, y) in enumerate(np.asarray(layout.position)):
        axis.annotate(f"{device + 1}", (x, y), ha="center", va="center", fontsize=7, color="white", zorder=3)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("m east")
    axis.set_ylabel("m north")


def uav_colour(uav: int) -> str:
    """Return the colour of a UAV; those of devices are others."""
    return to_hex(matplotlib.colormaps["Dark2"](uav % 8))


def draw_depots(axis: Axes, layout: Layout) -> None:
    """Draw depots as squares, filled where they swap batteries."""
    if (depots := layout.depots) is None:
        return
    swaps = np.asarray(depots.kind) == DepotKind.SWAP
    for chosen, colour, label in ((swaps, "black", "swap depot"), (~swaps, "white", "charging depot")):
        if chosen.any():
            x, y = np.asarray(depots.position)[chosen].T
            axis.scatter(x, y, s=70, marker="s", color=colour, edgecolors="black", label=label, zorder=2)


def map_pixels(
    scenario: Scenario, state: State, visited: int | Sequence[int] | None = None
) -> UInt8[np.ndarray, "480 640 3"]:
    """Draw a state of an episode.

    Args:
        scenario: its devices and depots are drawn.
        state: batteries (written below each device that lacks power), data ages (where communication is missing), UAVs.
        visited: the place just visited, for a fleet one per UAV; UAVs are ringed if it is given.

    Returns:
        Pixels ``[480, 640, 3]``, RGB.
    """
    figure = Figure(figsize=(6.4, 4.8), dpi=100, layout="constrained")
    axis, layout = figure.subplots(), scenario.layout
    draw_devices(axis, layout)
    fraction = np.asarray(state.battery) / np.asarray(layout.capacity)
    for device, position in enumerate(np.asarray(layout.position)):
        labels = [] if layout.has_power[device] else [f"{fraction[device]:.0%}"]
        labels += [] if layout.has_comms[device] else [f"age {int(state.age[device])}"]
        text = ", ".join(labels)
        axis.annotate(text, position, xytext=(0, -14), textcoords="offset points", ha="center", fontsize=7)
    draw_depots(axis, layout)
    _draw_uavs(axis, state, ringed=visited is not None)
    energies = ", ".join(f"{energy / 1000:.0f}" for energy in np.asarray(state.uav_energy)[:_MOST_ENERGIES])
    more = ", ..." * (layout.n_uavs > _MOST_ENERGIES)
    uavs = "UAV" if layout.n_uavs == 1 else "UAVs"
    axis.set_title(f"slot {int(state.slot)}, {uavs} {energies}{more} kJ", fontsize=10)
    legend_beside(axis, markerscale=0.7)
    return pixels(figure)


def _draw_uavs(axis: Axes, state: State, *, ringed: bool) -> None:
    """Draw the UAVs as crosses, pale where they are grounded."""
    grounded = np.zeros(len(state.uav_energy), bool) if state.grounded is None else np.asarray(state.grounded)
    for uav, (x, y) in enumerate(np.asarray(state.uav_position)):
        label = None if uav else "UAV"
        alpha = 0.25 if grounded[uav] else 0.7
        axis.plot(x, y, marker="X", color="black", ls="", ms=9, alpha=alpha, label=label, zorder=4)
        if ringed:
            axis.plot(x, y, marker="o", mfc="none", mec="black", ls="", ms=18, zorder=4)

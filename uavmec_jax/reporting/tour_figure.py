"""The figure of a plan: the map with each tour, and batteries and data ages over time."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uavmec_jax.planning.plan import Plan
from uavmec_jax.reporting.canvas import new_figure
from uavmec_jax.reporting.map_figure import draw_devices

_TITLES = {"rollout": "rollout planner", "beam": "beam (clairvoyant)"}


def tour_figure(plan: Plan, names: Sequence[str], scenario: str) -> Figure:
    """Draw one row per tour: the map, and the battery fractions and data ages after every slot.

    Args:
        plan: its tours are drawn.
        names: of the devices.
        scenario: its name.
    """
    figure = new_figure(14, 4.2 * len(plan.tours))
    axes = figure.subplots(len(plan.tours), 3, squeeze=False)
    for (map_axis, battery_axis, age_axis), (name, tour) in zip(axes, plan.tours.items(), strict=True):
        _draw_map(map_axis, plan, np.asarray(tour.action), f"{_TITLES[name]}: {len(tour.action)} slots")
        slots = np.arange(len(tour.action) + 1)
        for device, label in enumerate(names):
            colour = f"C{device % 10}"
            style = {"color": colour, "ls": "-" if device < 10 else "--", "lw": 1.3, "label": f"{device + 1} {label}"}
            if not plan.layout.has_power[device]:
                fraction = tour.state.battery[:, device] / plan.layout.capacity[device]
                battery_axis.plot(slots, np.append(1.0, fraction), **style)
            if not plan.layout.has_comms[device]:
                age_axis.step(slots, np.append(0, tour.state.age[:, device]), where="post", **style)
        _label(battery_axis, "battery, share of capacity", "batteries of devices without power")
        _label(age_axis, "age, slots", "data of devices without communication")
        battery_axis.set_ylim(0, 1.02)
    figure.suptitle(scenario, fontsize=11)
    return figure


def _draw_map(axis: Axes, plan: Plan, action: Int[np.ndarray, " H"], title: str) -> None:
    """Draw the devices, the tour, and the number of visits to each device."""
    layout = plan.layout
    stops = np.concatenate([np.zeros((1, 2)), layout.position[action]])
    axis.plot(stops[:, 0], stops[:, 1], color="0.6", lw=1.0, zorder=1)
    axis.plot(0, 0, marker="s", color="black", ls="", label="start")
    draw_devices(axis, layout)
    for device, (x, y) in enumerate(layout.position):
        visits = int(np.sum(action == device))
        axis.annotate(f"{visits}x", (x, y), xytext=(7, 5), textcoords="offset points", fontsize=7)
    axis.set_title(title, fontsize=10)
    axis.legend(fontsize=7, loc="best")


def _label(axis: Axes, quantity: str, title: str) -> None:
    """Label an axis over the slots; say so if nothing is drawn on it."""
    axis.set_xlabel("slot")
    axis.set_ylabel(quantity)
    axis.set_title(title, fontsize=10)
    axis.grid(alpha=0.3)
    if axis.has_data():
        axis.legend(fontsize=6, ncols=2, loc="best")
    else:
        axis.text(0.5, 0.5, "none", ha="center", va="center", transform=axis.transAxes)

"""The figure of a plan: the map with each tour, and batteries and data ages over time."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uavmec_jax.env.layout import fleet_of
from uavmec_jax.env.rollout import Trace
from uavmec_jax.planning.plan import Plan
from uavmec_jax.reporting.canvas import legend_beside, line_style, literal, new_figure
from uavmec_jax.reporting.map_figure import draw_depots, draw_devices, uav_colour
from uavmec_jax.reporting.tours import targets, uav_stops
from uavmec_jax.scenarios.named_scenario import NamedScenario

_TITLES = {"rollout": "rollout planner", "beam": "beam (clairvoyant)"}

_LEGEND_ROWS = 24
"""Most rows in a legend beside a panel."""


def tour_figure(plan: Plan, scenario: NamedScenario) -> Figure:
    """Draw one row per tour: the map, and the battery fractions and data ages after every slot; of fleets, also energies.

    Args:
        plan: its tours are drawn.
        scenario: it has the names and the region.
    """
    panels = 3 if plan.as_in_paper else 4
    figure = new_figure(6 * panels, 4.2 * len(plan.tours))
    axes = figure.subplots(len(plan.tours), panels, squeeze=False)
    for row, (name, tour) in zip(axes, plan.tours.items(), strict=True):
        _draw_map(row[0], plan, scenario, tour, f"{_TITLES[name]}: {len(tour.action)} slots")
        _draw_devices_over_time(row[1], row[2], plan, scenario, tour)
        if panels == 4:
            _draw_energies(row[3], plan, scenario, tour)
    figure.suptitle(literal(scenario.name), fontsize=11)
    return figure


def _draw_devices_over_time(
    battery_axis: Axes, age_axis: Axes, plan: Plan, scenario: NamedScenario, tour: Trace
) -> None:
    """Draw the battery of each device without power, and the data age of each device without communication."""
    slots = np.arange(len(tour.action) + 1)
    for device, label in enumerate(scenario.device_names):
        style: Any = line_style(device) | {"lw": 1.3, "label": literal(f"{device + 1} {label}")}
        if not plan.layout.has_power[device]:
            fraction = tour.state.battery[:, device] / plan.layout.capacity[device]
            battery_axis.plot(slots, np.append(1.0, fraction), **style)
        if not plan.layout.has_comms[device]:
            age_axis.step(slots, np.append(0, tour.state.age[:, device]), where="post", **style)
    _label(battery_axis, "battery, share of capacity", "batteries of devices without power")
    _label(age_axis, "age, slots", "data of devices without communication")
    battery_axis.set_ylim(0, 1.02)


def _draw_energies(axis: Axes, plan: Plan, scenario: NamedScenario, tour: Trace) -> None:
    """Draw the energy in each UAV; it jumps where a depot swaps its battery."""
    slots, full = np.arange(len(tour.action) + 1), fleet_of(plan.params, plan.layout).battery_j
    for uav, name in enumerate(map(literal, scenario.uav_names)):
        energy = np.append(float(full[uav]), tour.state.uav_energy[:, uav]) / 1e3
        axis.plot(slots, energy, color=uav_colour(uav), lw=1.3, label=name)
    _label(axis, "energy, kJ", "UAVs")
    axis.set_ylim(bottom=0)


def _draw_map(axis: Axes, plan: Plan, scenario: NamedScenario, tour: Trace, title: str) -> None:
    """Draw region, depots and devices, the tour of each UAV, and the number of visits to each device."""
    layout = plan.layout
    if (corners := scenario.region_corners) is not None:
        axis.plot(*np.concatenate([corners, corners[:1]]).T, color="0.7", lw=0.8, ls=":", zorder=0, label="region")
    for uav, name in enumerate(map(literal, scenario.uav_names)):
        stops = uav_stops(plan, tour, uav)
        alone = len(scenario.uav_names) == 1
        colour = "0.6" if alone else uav_colour(uav)
        axis.plot(stops[:, 0], stops[:, 1], color=colour, lw=1.0, zorder=1, label=None if alone else name)
        if tour.state.grounded[-1, uav]:
            grounded = None if alone else f"{name} grounded"
            axis.plot(*stops[-1], marker="x", color=colour, ls="", ms=9, mew=2, zorder=4, label=grounded)
    if layout.n_depots:
        draw_depots(axis, layout)
    else:
        _draw_starts(axis, np.asarray(fleet_of(plan.params, layout).start_m))
    draw_devices(axis, layout)
    for device, (x, y) in enumerate(layout.position):
        visits = int(np.sum(targets(tour) == device))
        axis.annotate(f"{visits}x", (x, y), xytext=(7, 5), textcoords="offset points", fontsize=7)
    axis.plot([], [], ls="", label="3x: visited three times")
    axis.set_title(title, fontsize=10)
    legend_beside(axis, markerscale=0.7)


def _draw_starts(axis: Axes, starts: Float[np.ndarray, "K 2"]) -> None:
    axis.plot(*starts.T, marker="s", color="black", ls="", label="start")


def _label(axis: Axes, quantity: str, title: str) -> None:
    """Label an axis over the slots; say so if nothing is drawn on it."""
    axis.set_xlabel("slot")
    axis.set_ylabel(quantity)
    axis.set_title(title, fontsize=10)
    axis.grid(alpha=0.3)
    if axis.has_data():
        lines = len(axis.get_legend_handles_labels()[0])
        legend_beside(axis, fontsize=6, ncols=-(-lines // _LEGEND_ROWS))
    else:
        axis.text(0.5, 0.5, "none", ha="center", va="center", transform=axis.transAxes)

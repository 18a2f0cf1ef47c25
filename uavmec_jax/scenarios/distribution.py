"""Distributions of scenarios in study files, and how a scenario differs from one."""

from collections.abc import Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

from uavmec_jax.env import hardware
from uavmec_jax.env.fleet import UAV_FIELDS
from uavmec_jax.env.generator import ScenarioDistribution
from uavmec_jax.env.layout import Layout, fleet_of
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import Reward
from uavmec_jax.files.validation import from_array, model_from_dataclasses
from uavmec_jax.traffic.evacuation import load_evacuation

_DistributionSettings: Any = model_from_dataclasses(
    "DistributionSettings", ScenarioDistribution, leave_out=("params", "reward", "traffic_weights")
)


class ScenarioSettings(_DistributionSettings):
    """The table ``scenarios`` of a study file; see :class:`ScenarioDistribution`."""

    places: Annotated[tuple[str, ...], Field(min_length=1), from_array] = ("albany", "round_lake")
    """Simulated evacuations whose devices' traffic weights are resampled."""


_FACTORS = ("region_m", "battery_factor", "hardware_factor", "uav_factor")
"""Ranges of positive numbers."""

_SHARES = ("powered", "connected")
"""Ranges of numbers from 0 to 1."""


def check_scenarios(scenarios: ScenarioSettings, n_devices: int) -> None:
    """Check that all ranges are valid, and that layouts of ``n_devices`` entries are large enough.

    Raises:
        ValueError: one line that names the setting.
    """
    for name in ("devices", *_SHARES, *_FACTORS, "traffic_price"):
        low, high = getattr(scenarios, name)
        least, most = (2, n_devices) if name == "devices" else (0, 1) if name in _SHARES else (0, np.inf)
        positive = name in _FACTORS
        if not least <= low <= high <= most or (positive and not low > 0):
            bounds = f"{'0 <' if positive else f'{least} <='} low <= high" + (f" <= {most}" if most < np.inf else "")
            raise ValueError(f"scenarios.{name} is {[low, high]}; give [low, high] with {bounds}")
    if scenarios.typical_devices > n_devices:
        raise ValueError(
            f"scenarios.typical_devices is {scenarios.typical_devices}; params.n_devices, {n_devices}, is the most"
        )
    if scenarios.typical_least > scenarios.typical_devices:
        raise ValueError(f"scenarios.typical_least is {scenarios.typical_least}; typical_devices is the most")


def make_distribution(scenarios: ScenarioSettings, params: Params, reward: Reward, agents: int) -> ScenarioDistribution:
    """Make the distribution that a study's agents draw from, leaves ``[A, ...]``.

    Args:
        scenarios: settings of the study.
        params: leaves ``[A]``.
        reward: leaves ``[A, ...]``.
        agents: number of agents ``A``.

    Raises:
        TrafficError: a place is not usable.
    """
    weights = np.concatenate([load_evacuation(place).weight for place in scenarios.places])
    settings = scenarios.model_dump(exclude={"places"}) | {"traffic_weights": weights}
    leaves = jax.tree.map(
        lambda value: jnp.broadcast_to(jnp.asarray(value, jnp.float32), (agents, *np.shape(value))), settings
    )
    return ScenarioDistribution(params=params, reward=reward, **leaves)


def out_of_distribution(
    scenarios: Mapping[str, Any], trained: Mapping[str, Any], params: Params, layout: Layout
) -> list[str]:
    """Compare a scenario with a training distribution and describe each quantity that lies outside, one line each.

    Args:
        scenarios: settings of the distribution, as in a study file.
        trained: scenario parameters of the training, by name.
        params: parameters of the scenario.
        layout: devices of the scenario.
    """
    outside = [
        f"{name}: {_span(values)}; it was trained on {_span(bounds)}"
        for name, (values, bounds) in _drawn_quantities(scenarios, trained, params, layout).items()
        if np.min(values) < bounds[0] * (1 - 1e-6) or np.max(values) > bounds[1] * (1 + 1e-6)
    ]
    return outside + _changed_constants({"end": "first_failure"} | dict(trained), params, layout)


def _changed_constants(trained: Mapping[str, Any], params: Params, layout: Layout) -> list[str]:
    """Describe each parameter that was the same in all scenarios of the training and is another one here."""
    unused = () if params.end == "horizon" else ("horizon_s", "end_share")
    changed = []
    for name, value in trained.items():
        if name in _NOT_CONSTANT or name in unused:
            continue
        here, field = getattr(params, name), name.removeprefix("uav_")
        if layout.fleet is not None and field in UAV_FIELDS:
            here = np.asarray(getattr(layout.fleet, field))
        same = here == value if isinstance(value, str) else np.allclose(here, np.asarray(value, float), rtol=1e-5)
        if not same:
            changed.append(
                f"{name}: {_span(here) if isinstance(here, np.ndarray) else here}; it was trained on {value}"
            )
    return changed


_NOT_CONSTANT = ("n_devices", "region_m", "device_battery_range_j", "uav_battery_j", "uav_speed_m_s", "max_slots")
"""Parameters that a distribution draws, that the layout replaces, or that do not matter to a policy."""


def _drawn_quantities(
    scenarios: Mapping[str, Any], trained: Mapping[str, Any], params: Params, layout: Layout
) -> dict[str, tuple[Any, tuple[float, float]]]:
    """Return each quantity that a distribution draws: its values in the scenario, and the range they were drawn from."""
    low, high = (trained["device_battery_range_j"][side] * scenarios["battery_factor"][side] for side in (0, 1))
    devices, factors = jax.tree.map(np.asarray, layout), scenarios["hardware_factor"]
    extent = float(np.max(np.ptp(np.concatenate([layout.places(), np.zeros((1, 2))]), axis=0)))
    fleet = fleet_of(params, layout)
    hardware_range = lambda table: (table.min() * factors[0], table.max() * factors[1])  # noqa: E731
    uav_range = lambda name: tuple(trained[name] * factor for factor in scenarios["uav_factor"])  # noqa: E731
    return {
        "devices": (len(devices.capacity), tuple(scenarios["devices"])),
        "extent in m": (extent, (0.0, max(scenarios["region_m"][1], *trained["region_m"]))),
        "battery capacities in J": (devices.capacity, (low, high)),
        "standby powers in W": (devices.standby_power, hardware_range(hardware.STANDBY_POWER_W)),
        "active powers in W": (devices.active_power, hardware_range(hardware.ACTIVE_POWER_W)),
        "processing rates in bytes/s": (devices.processing_rate, hardware_range(hardware.PROCESSING_RATE_BYTES_S)),
        "UAVs": (layout.n_uavs, (1, 1)),
        "depots": (layout.n_depots, (0, 0)),
        "the UAV's battery in J": (fleet.battery_j, uav_range("uav_battery_j")),
        "the UAV's speed in m/s": (fleet.speed_m_s, uav_range("uav_speed_m_s")),
    }


def _span(values: Any) -> str:
    """Format numbers as their only value, or as the range that they span."""
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:,.6g}" if low == high else f"{low:,.6g} to {high:,.6g}"

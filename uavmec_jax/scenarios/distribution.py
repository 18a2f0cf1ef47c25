"""Distributions of scenarios in study files, and how a scenario differs from one."""

from collections.abc import Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

from uavmec_jax.env import hardware
from uavmec_jax.env.generator import ScenarioDistribution
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import Reward
from uavmec_jax.files.validation import from_array, model_from_dataclasses
from uavmec_jax.traffic.evacuation import load_evacuation

_Declared: Any = model_from_dataclasses(
    "Declared", ScenarioDistribution, leave_out=("params", "reward", "traffic_weights")
)


class ScenarioSettings(_Declared):
    """The table ``scenarios`` of a study file; see :class:`ScenarioDistribution`."""

    places: Annotated[tuple[str, ...], Field(min_length=1), from_array] = ("albany", "round_lake")
    """Simulated evacuations whose devices' traffic weights are resampled."""


_FACTORS = ("region_m", "battery_factor", "hardware_factor", "uav_factor")
_SHARES = ("powered", "connected")


def check_scenarios(scenarios: Any, n_devices: int) -> None:
    """Refuse ranges that are none, and more devices than a layout holds.

    Raises:
        ValueError: one line, the setting named.
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


def make_distribution(scenarios: Any, params: Params, reward: Reward, agents: int) -> ScenarioDistribution:
    """The distribution of a study for ``agents`` agents, leaves ``[A, ...]``.

    Args:
        scenarios: the study's settings.
        params: leaves ``[A]``.
        reward: leaves ``[A, ...]``.
        agents: how many.

    Raises:
        TrafficError: a place is not usable.
    """
    weights = np.concatenate([load_evacuation(place).weight for place in scenarios.places])
    plain = scenarios.model_dump(exclude={"places"}) | {"traffic_weights": weights}
    spread = jax.tree.map(
        lambda value: jnp.broadcast_to(jnp.asarray(value, jnp.float32), (agents, *np.shape(value))), plain
    )
    return ScenarioDistribution(params=params, reward=reward, **spread)


def out_of_distribution(
    scenarios: Mapping[str, Any], trained: Mapping[str, Any], params: Params, layout: Layout
) -> list[str]:
    """Compare a scenario with a distribution: a line for each quantity that lies outside.

    Args:
        scenarios: the settings of the distribution, as plain data.
        trained: the scenario parameters that were not drawn, as plain data.
        params: of the scenario.
        layout: of the scenario.
    """
    found = [
        f"{name}: {_span(values)}; it was trained on {_span(known)}"
        for name, (values, known) in _measured(scenarios, trained, params, layout).items()
        if np.min(values) < known[0] * (1 - 1e-6) or np.max(values) > known[1] * (1 + 1e-6)
    ]
    same = {name: getattr(params, name) for name in trained if name not in _DRAWN}
    return found + [
        f"{name}: {value}; it was trained on {trained[name]}"
        for name, value in same.items()
        if not np.allclose(np.asarray(value, float), np.asarray(trained[name], float), rtol=1e-5)
    ]


def _measured(
    scenarios: Mapping[str, Any], trained: Mapping[str, Any], params: Params, layout: Layout
) -> dict[str, tuple[Any, tuple[float, float]]]:
    """Each quantity that is drawn, with the range it was drawn from."""
    low, high = (trained["device_battery_range_j"][side] * scenarios["battery_factor"][side] for side in (0, 1))
    own, factors = jax.tree.map(np.asarray, layout), scenarios["hardware_factor"]
    extent = float(np.max(np.ptp(np.concatenate([own.position, np.zeros((1, 2))]), axis=0)))
    within = lambda table: (table.min() * factors[0], table.max() * factors[1])  # noqa: E731
    of_uav = lambda name: tuple(trained[name] * factor for factor in scenarios["uav_factor"])  # noqa: E731
    return {
        "devices": (len(own.capacity), tuple(scenarios["devices"])),
        "extent in m": (extent, (0.0, max(scenarios["region_m"][1], *trained["region_m"]))),
        "battery capacities in J": (own.capacity, (low, high)),
        "standby powers in W": (own.standby_power, within(hardware.STANDBY_POWER_W)),
        "active powers in W": (own.active_power, within(hardware.ACTIVE_POWER_W)),
        "processing rates in bytes/s": (own.processing_rate, within(hardware.PROCESSING_RATE_BYTES_S)),
        "the UAV's battery in J": (params.uav_battery_j, of_uav("uav_battery_j")),
        "the UAV's speed in m/s": (params.uav_speed_m_s, of_uav("uav_speed_m_s")),
    }


_DRAWN = ("n_devices", "region_m", "device_battery_range_j", "uav_battery_j", "uav_speed_m_s", "max_slots")
"""Parameters that a distribution draws, that a layout overrides, or that do not matter."""


def _span(values: Any) -> str:
    """One number, or a range."""
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:,.6g}" if low == high else f"{low:,.6g} to {high:,.6g}"

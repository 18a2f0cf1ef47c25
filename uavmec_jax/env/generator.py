"""Distributions of scenarios: a fresh town, with other devices, hardware and traffic, at every reset."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from uavmec_jax.env import hardware as tables
from uavmec_jax.env.layout import Layout, Traffic, make_layout, mask_absent
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import Reward
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.env.types import Range, Scalar

_SCENARIO_STREAM = 2**32 - 2
"""``fold_in`` number of a draw's scenario; the slots' volumes and the policy use their own numbers."""


@struct.dataclass
class ScenarioDistribution:
    """What scenarios are drawn from; a pytree whose leaves may be traced. Ranges are ``(low, high)``.

    With probability ``typical`` a scenario has the numbers of ``params`` and ``typical_devices`` devices, of which at least
    ``typical_least`` have power and at least as many communication (the paper's grid); else every range is drawn from.

    Attributes:
        params: what is not drawn; ``n_devices`` is the size that layouts are padded to.
        reward: of every scenario.
        typical: probability of a typical scenario.
        typical_devices: devices of a typical scenario.
        typical_least: least number of its devices with power, and of those with communication.
        devices: number of devices, uniform.
        powered: share of devices with power, uniform.
        connected: share of devices with communication, uniform.
        region_m: m, side of the square region, log-uniform.
        battery_factor: on the range of the devices' capacities, log-uniform.
        hardware_factor: on each device's two powers and its rate, separately, log-uniform.
        uav_factor: on the UAV's battery and on its speed, separately, log-uniform.
        traffic: probability that failures have a price.
        traffic_price: slots, see :class:`Traffic`; uniform.
        traffic_weights: ``[m]`` weights in [0, 1] of devices in simulated evacuations. Half of the devices draw from them,
            the others have squares of uniform numbers.
    """

    params: Params
    reward: Reward
    typical: Scalar = struct.field(default=0.5, metadata={"ge": 0, "le": 1})
    typical_devices: Scalar = struct.field(default=12, metadata={"ge": 2, "le": 64})
    typical_least: Scalar = struct.field(default=4, metadata={"ge": 0, "le": 64})
    devices: Range = (4, 16)
    powered: Range = (0.0, 1.0)
    connected: Range = (0.0, 1.0)
    region_m: Range = (300.0, 2500.0)
    battery_factor: Range = (0.5, 2.0)
    hardware_factor: Range = (0.7, 1.4)
    uav_factor: Range = (0.7, 1.4)
    traffic: Scalar = struct.field(default=0.5, metadata={"ge": 0, "le": 1})
    traffic_price: Range = (0.0, 20.0)
    traffic_weights: tuple[float, ...] | Float[Array, "*batch m"] = (0.0,)


def sample_scenario(distribution: ScenarioDistribution, key: PRNGKeyArray) -> Scenario:
    """Draw a scenario; its layout has ``params.n_devices`` entries, the last of which may be padding."""
    k_numbers, k_layout, k_traffic = jax.random.split(key, 3)
    numbers = iter(jax.random.uniform(k_numbers, (9,)))
    typical = next(numbers) < distribution.typical
    most = distribution.typical_devices
    count = jnp.where(typical, most, _whole(next(numbers), *distribution.devices))
    n_powered, n_connected = (
        jnp.where(
            typical, _whole(number, distribution.typical_least, most), jnp.round(count * _between(number, *share))
        )
        for number, share in ((next(numbers), distribution.powered), (next(numbers), distribution.connected))
    )
    params = _params(distribution, typical, numbers)
    layout = _layout(distribution, k_layout, params, typical, count, n_powered, n_connected)
    traffic = _traffic(distribution, k_traffic)
    paid = distribution.reward.per_slot * traffic.price
    return Scenario(
        params=params,
        layout=replace(layout, traffic=traffic),
        reward=replace(distribution.reward, traffic_penalty=paid),
    )


def scenario_from_draw(distribution: ScenarioDistribution, key: PRNGKeyArray) -> Scenario:
    """The scenario that a draw stands for; the volumes of :func:`rollout` with the same key are the rest of it."""
    return sample_scenario(distribution, jax.random.fold_in(key, _SCENARIO_STREAM))


def _params(distribution: ScenarioDistribution, typical: Bool[Array, ""], numbers: Iterator[Array]) -> Params:
    """The scenario parameters, some of them drawn."""
    params = distribution.params
    side = _log_between(next(numbers), *distribution.region_m)
    battery, energy, speed = (
        jnp.where(typical, 1.0, _log_between(next(numbers), *bounds))
        for bounds in (distribution.battery_factor, distribution.uav_factor, distribution.uav_factor)
    )
    return replace(
        params,
        region_m=(jnp.where(typical, params.region_m[0], side), jnp.where(typical, params.region_m[1], side)),
        device_battery_range_j=(params.device_battery_range_j[0] * battery, params.device_battery_range_j[1] * battery),
        uav_battery_j=params.uav_battery_j * energy,
        uav_speed_m_s=params.uav_speed_m_s * speed,
    )


def _layout(
    distribution: ScenarioDistribution,
    key: PRNGKeyArray,
    params: Params,
    typical: Bool[Array, ""],
    count: Any,
    n_powered: Any,
    n_connected: Any,
) -> Layout:
    """The first ``count`` entries are devices, drawn as :func:`sample_layout` draws them but for the hardware."""
    size = params.n_devices
    u = jax.random.uniform(key, (size, 10))
    present = jnp.arange(size) < count
    factors = jnp.where(typical, 1.0, _log_between(u[:, 7:], *distribution.hardware_factor))
    layout = make_layout(
        position=u[:, :2] * jnp.stack([jnp.asarray(side, jnp.float32) for side in params.region_m]),
        device_type=_whole(u[:, 2], 0, len(tables.DEVICE_TYPES) - 1),
        task=_whole(u[:, 3], 0, len(tables.TASKS) - 1),
        capacity=_between(u[:, 4], *params.device_battery_range_j),
        has_power=_first(u[:, 5], present, n_powered),
        has_comms=_first(u[:, 6], present, n_connected),
    )
    layout = replace(
        layout,
        standby_power=layout.standby_power * factors[:, 0],
        active_power=layout.active_power * factors[:, 1],
        processing_rate=layout.processing_rate * factors[:, 2],
    )
    return mask_absent(layout, present)


def _first(order: Float[Array, " n"], present: Bool[Array, " n"], count: Any) -> Bool[Array, " n"]:
    """The ``count`` first of those present in a random order."""
    order = jnp.where(present, order, 2.0)
    return jnp.sum(order[None, :] < order[:, None], axis=1) < count


def _traffic(distribution: ScenarioDistribution, key: PRNGKeyArray) -> Traffic:
    """Weights of all devices and what a first failure costs."""
    known = jnp.asarray(distribution.traffic_weights, jnp.float32)
    u = jax.random.uniform(key, (distribution.params.n_devices + 1, 3))
    resampled = known[_whole(u[1:, 1], 0, known.shape[0] - 1)]
    weight = jnp.where(u[1:, 0] < 0.5, resampled, u[1:, 2] ** 2)
    price = jnp.where(u[0, 0] < distribution.traffic, _between(u[0, 1], *distribution.traffic_price), 0.0)
    return Traffic(weight=weight[None], window_s=jnp.float32(jnp.inf), price=price)


def _between(uniform: Float[Array, "*s"], low: Any, high: Any) -> Float[Array, "*s"]:
    return low + uniform * (high - low)


def _log_between(uniform: Float[Array, "*s"], low: Any, high: Any) -> Float[Array, "*s"]:
    return low * jnp.exp(uniform * jnp.log(high / low))


def _whole(uniform: Float[Array, "*s"], low: Any, high: Any) -> Int[Array, "*s"]:
    """A whole number from ``low`` to ``high``, both included, from a number in [0, 1)."""
    return (low + jnp.floor(uniform * (high - low + 1))).astype(jnp.int32)

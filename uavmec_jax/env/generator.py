"""Distributions of scenarios: each draw has other devices, hardware and traffic."""

import dataclasses
from collections.abc import Iterator
from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Num, PRNGKeyArray

from uavmec_jax.env import hardware
from uavmec_jax.env.checks import LARGEST, MAX_LENGTH_M, SMALLEST, Bounds, Check, check_ranges, check_rising
from uavmec_jax.env.layout import Layout, Traffic, make_layout
from uavmec_jax.env.padding import mask_absent
from uavmec_jax.env.params import MAX_DEVICES, Params, check_params
from uavmec_jax.env.rewards import Reward
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.env.types import Range, Scalar

_SCENARIO_STREAM = 2**32 - 2
"""``fold_in`` number of a draw's scenario; the volumes of the slots and the policy have other numbers."""


@struct.dataclass
class ScenarioDistribution:
    """A distribution of scenarios: a pytree whose leaves may be traced. Ranges are ``(low, high)``.

    With probability ``typical`` a scenario has the numbers of ``params`` and ``typical_devices`` devices, of which at least
    ``typical_least`` have power and at least ``typical_least`` have communication (the paper's grid). Otherwise its numbers
    are drawn from the ranges.

    Attributes:
        params: the parameters that are not drawn; layouts are padded to ``n_devices`` entries.
        reward: the reward of every scenario.
        typical: probability of a typical scenario.
        typical_devices: number of devices in a typical scenario.
        typical_least: smallest number of devices with power, and with communication, in a typical scenario.
        devices: number of devices, uniform.
        powered: fraction of the devices with power, uniform.
        connected: fraction of the devices with communication, uniform.
        region_m: side of the square region, m, log-uniform.
        battery_factor: factor on the range of the devices' capacities, log-uniform.
        hardware_factor: factor on each device's two powers and its rate, drawn separately, log-uniform.
        uav_factor: factor on the UAV's battery and on its speed, drawn separately, log-uniform.
        traffic: probability that failures have a price.
        traffic_price: price of a first failure, in slots of lifetime, uniform; see :class:`Traffic`.
        traffic_weights: weights in [0, 1] of devices in simulated evacuations. Half of the devices draw their weight from
            these, the other half have the square of a uniform number.
    """

    params: Params
    reward: Reward
    typical: Scalar = struct.field(default=0.5, metadata={"ge": 0, "le": 1})
    typical_devices: Scalar = struct.field(default=12, metadata={"ge": 2, "le": MAX_DEVICES})
    typical_least: Scalar = struct.field(default=4, metadata={"ge": 0, "le": MAX_DEVICES})
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


_AT_LEAST = Bounds(ge=0, le=LARGEST)
_BOUNDS = {
    **{name: Bounds(ge=0, le=1) for name in ("typical", "powered", "connected", "traffic", "traffic_weights")},
    **{name: Bounds(ge=0, le=MAX_DEVICES) for name in ("typical_devices", "typical_least", "devices")},
    **{name: Bounds(ge=1e-6, le=1e6) for name in ("battery_factor", "hardware_factor", "uav_factor")},
    "region_m": Bounds(ge=SMALLEST, le=MAX_LENGTH_M),
}
_RISING = [field.name for field in dataclasses.fields(ScenarioDistribution) if field.type == Range]


def check_distribution(distribution: ScenarioDistribution, name: str = "distribution") -> None:
    """Check every number of a distribution that is known.

    Raises:
        ArgumentError: one line that names the field.
    """
    check_params(distribution.params, f"{name}.params")
    check_ranges(
        [
            Check(f"{name}.{field.name}", leaf, _BOUNDS.get(field.name, _AT_LEAST), ("value",))
            for field in dataclasses.fields(distribution)
            if field.name not in ("params", "reward")
            for leaf in jax.tree.leaves(getattr(distribution, field.name))  # one end of a range may be traced
        ]
    )
    for field in _RISING:
        check_rising(f"{name}.{field}", getattr(distribution, field))


def sample_scenario(distribution: ScenarioDistribution, key: PRNGKeyArray) -> Scenario:
    """Draw a scenario; its layout has ``params.n_devices`` entries, of which the last ones may be padding.

    Raises:
        ArgumentError: a number of the distribution is out of range; one line.
    """
    check_distribution(distribution)
    k_numbers, k_layout, k_traffic = jax.random.split(key, 3)
    numbers = iter(jax.random.uniform(k_numbers, (9,)))
    typical = next(numbers) < distribution.typical
    most = distribution.typical_devices
    count = jnp.where(typical, most, _uniform_int(next(numbers), *distribution.devices))
    n_powered, n_connected = (
        jnp.where(
            typical, _uniform_int(number, distribution.typical_least, most), jnp.round(count * _uniform(number, *share))
        )
        for number, share in ((next(numbers), distribution.powered), (next(numbers), distribution.connected))
    )
    params = _draw_params(distribution, typical, numbers)
    layout = _draw_layout(distribution, k_layout, params, typical, count, n_powered, n_connected)
    traffic = _draw_traffic(distribution, k_traffic)
    penalty = distribution.reward.per_slot * traffic.price
    return Scenario(
        params=params,
        layout=replace(layout, traffic=traffic),
        reward=replace(distribution.reward, traffic_penalty=penalty),
    )


def scenario_from_draw(distribution: ScenarioDistribution, key: PRNGKeyArray) -> Scenario:
    """Draw the scenario that belongs to a key; :func:`rollout` draws the task volumes from the same key."""
    return sample_scenario(distribution, jax.random.fold_in(key, _SCENARIO_STREAM))


def _draw_params(distribution: ScenarioDistribution, typical: Bool[Array, ""], numbers: Iterator[Array]) -> Params:
    """Draw region, batteries and speed; the other parameters are those of the distribution."""
    params = distribution.params
    side = _log_uniform(next(numbers), *distribution.region_m)
    battery, energy, speed = (
        jnp.where(typical, 1.0, _log_uniform(next(numbers), *bounds))
        for bounds in (distribution.battery_factor, distribution.uav_factor, distribution.uav_factor)
    )
    return replace(
        params,
        region_m=(jnp.where(typical, params.region_m[0], side), jnp.where(typical, params.region_m[1], side)),
        device_battery_range_j=(params.device_battery_range_j[0] * battery, params.device_battery_range_j[1] * battery),
        uav_battery_j=params.uav_battery_j * energy,
        uav_speed_m_s=params.uav_speed_m_s * speed,
    )


def _draw_layout(
    distribution: ScenarioDistribution,
    key: PRNGKeyArray,
    params: Params,
    typical: Bool[Array, ""],
    count: Num[Array, ""],
    n_powered: Num[Array, ""],
    n_connected: Num[Array, ""],
) -> Layout:
    """Draw ``count`` devices as :func:`sample_layout` does, but with varied hardware, and padding after them."""
    size = params.n_devices
    u = jax.random.uniform(key, (size, 10))
    present = jnp.arange(size) < count
    factors = jnp.where(typical, 1.0, _log_uniform(u[:, 7:], *distribution.hardware_factor))
    layout = make_layout(
        position=u[:, :2] * jnp.stack([jnp.asarray(side, jnp.float32) for side in params.region_m]),
        device_type=_uniform_int(u[:, 2], 0, len(hardware.DEVICE_TYPES) - 1),
        task=_uniform_int(u[:, 3], 0, len(hardware.TASKS) - 1),
        capacity=_uniform(u[:, 4], *params.device_battery_range_j),
        has_power=_choose(u[:, 5], present, n_powered),
        has_comms=_choose(u[:, 6], present, n_connected),
    )
    layout = replace(
        layout,
        standby_power=layout.standby_power * factors[:, 0],
        active_power=layout.active_power * factors[:, 1],
        processing_rate=layout.processing_rate * factors[:, 2],
    )
    return mask_absent(layout, present)


def _choose(order: Float[Array, " n"], present: Bool[Array, " n"], count: Num[Array, ""]) -> Bool[Array, " n"]:
    """Choose ``count`` of the devices that are present: those with the smallest numbers in ``order``, all in [0, 1)."""
    order = jnp.where(present, order, 2.0)
    return jnp.sum(order[None, :] < order[:, None], axis=1) < count


def _draw_traffic(distribution: ScenarioDistribution, key: PRNGKeyArray) -> Traffic:
    """Draw the traffic weights of all devices and the price of a first failure."""
    simulated = jnp.asarray(distribution.traffic_weights, jnp.float32)
    u = jax.random.uniform(key, (distribution.params.n_devices + 1, 3))
    resampled = simulated[_uniform_int(u[1:, 1], 0, simulated.shape[0] - 1)]
    weight = jnp.where(u[1:, 0] < 0.5, resampled, u[1:, 2] ** 2)
    price = jnp.where(u[0, 0] < distribution.traffic, _uniform(u[0, 1], *distribution.traffic_price), 0.0)
    return Traffic(weight=weight[None], window_s=jnp.float32(jnp.inf), price=price)


def _uniform(u: Float[Array, "*s"], low: Scalar, high: Scalar) -> Float[Array, "*s"]:
    """Scale numbers in [0, 1) to [low, high)."""
    return low + u * (high - low)


def _log_uniform(u: Float[Array, "*s"], low: Scalar, high: Scalar) -> Float[Array, "*s"]:
    """Scale numbers in [0, 1) to [low, high), uniformly in the logarithm."""
    return low * jnp.exp(u * jnp.log(high / low))


def _uniform_int(u: Float[Array, "*s"], low: Scalar, high: Scalar) -> Int[Array, "*s"]:
    """Turn numbers in [0, 1) into integers from ``low`` to ``high``, both included."""
    return (low + jnp.floor(u * (high - low + 1))).astype(jnp.int32)

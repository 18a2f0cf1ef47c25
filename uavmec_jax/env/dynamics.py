"""The dynamics of one time slot, a pure function of explicit task volumes (paper, sections 3.1 and 4)."""

import enum
import math
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.types import Scalar


class Cause(enum.IntEnum):
    """Why an episode ended."""

    NONE = 0
    """It has not ended."""
    BATTERY = 1
    """A device's battery is empty (constraint 1e)."""
    DATA_AGE = 2
    """A device's data are too old (constraint 1g)."""
    UAV = 3
    """The UAV's battery does not cover the next slot."""


@struct.dataclass
class State:
    """The state of the network between two slots.

    Attributes:
        battery: energy left in each device, J.
        age: slots since each device's data were last delivered, int32.
        uav_position: position of the UAV, m.
        uav_energy: energy left in the UAV, J.
        slot: slots completed, int32.
        elapsed: total length of the slots completed, s.
    """

    battery: Float[Array, "*batch n"]
    age: Int[Array, "*batch n"]
    uav_position: Float[Array, "*batch 2"]
    uav_energy: Float[Array, "*batch"]
    slot: Int[Array, "*batch"]
    elapsed: Scalar = 0.0


@struct.dataclass
class Outcome:
    """The result of one slot.

    Attributes:
        cause: why the episode ended with this slot, a :class:`Cause` as int32.
        failed: devices that failed in this slot.
        served: devices within range of the hover point.
        duration: length of the slot, s; 0 if it never started.
        first_failure: each device's share in the first failure. Shares sum to 1 if a device failed: the battery that
            runs out earliest inside the slot has all of it; devices whose data expired share it equally.
    """

    cause: Int[Array, "*batch"]
    failed: Bool[Array, "*batch n"]
    served: Bool[Array, "*batch n"]
    duration: Float[Array, "*batch"]
    first_failure: Float[Array, "*batch n"]


def initial_state(params: Params, layout: Layout) -> State:
    """Return the state before the first slot: full batteries, fresh data, the UAV in the origin corner."""
    return State(
        battery=jnp.asarray(layout.capacity, jnp.float32),
        age=jnp.zeros(layout.capacity.shape, jnp.int32),
        uav_position=jnp.zeros((2,), jnp.float32),
        uav_energy=jnp.asarray(params.uav_battery_j, jnp.float32),
        slot=jnp.zeros((), jnp.int32),
        elapsed=jnp.zeros((), jnp.float32),
    )


def slots_to_expiry(params: Params) -> Int[Array, "*batch"]:
    """Return after how many slots without service fresh data expire: 11 with the paper's limit of 10."""
    return jnp.where(params.age_at_limit_fails, params.data_age_limit_slots, params.data_age_limit_slots + 1)


def upload_rate(params: Params, slant_distance_m: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the Shannon rate of an upload to the UAV, bit/s (paper, equation 4); each served device has the full band."""
    gain = params.reference_gain * jnp.exp(-params.path_loss_exponent * jnp.log(slant_distance_m))
    snr = params.transmit_power_w * gain / params.noise_power_w
    return params.bandwidth_hz * _log1p(snr) / math.log(2.0)


def _log1p(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return ``log(1 + x)`` for ``x >= 0`` with a relative error below 3e-7.

    XLA's ``log1p`` costs as much as the rest of the slot. Small arguments use the series of ``2 artanh(x / (2 + x))``.
    """
    z = x / (2.0 + x)
    square = z * z
    series = 2.0 * z * (1.0 + square * (1 / 3 + square * (1 / 5 + square * (1 / 7))))
    return jnp.where(x < 0.25, series, jnp.log(1.0 + x))


def transition(
    params: Params, layout: Layout, state: State, action: Int[ArrayLike, ""], volumes: Num[Array, " n"]
) -> tuple[State, Outcome]:
    """Fly to a device, serve all devices in range, let the others compute, and check for failures.

    Args:
        params: scenario parameters.
        layout: the devices, without batch axes (use ``vmap``).
        state: the state before the slot.
        action: int in ``[0, n)``, the device to visit; staying is allowed. (Out of range is clamped, as JAX indexes.)
        volumes: ``[n]`` bytes, each device's task in this slot.

    Returns:
        The state after the slot and its :class:`Outcome`. If the UAV's battery does not cover the slot, nothing
        happens in it.
    """
    n = layout.capacity.shape[-1]
    chex.assert_shape([layout.capacity, state.battery, state.age, volumes], (n,))
    chex.assert_rank(action, 0)
    hover_point = layout.position[action]
    t_fly = jnp.linalg.norm(hover_point - state.uav_position) / params.uav_speed_m_s
    ground = layout.position - hover_point
    slant = jnp.sqrt(jnp.sum(ground**2, axis=-1) + params.uav_altitude_m**2)
    served = (slant <= params.uav_signal_range_m) | (jnp.arange(n) == action)

    t_upload = 8.0 * volumes / upload_rate(params, slant)
    t_compute = jnp.minimum(volumes / layout.processing_rate, params.slot_cap_s)
    t_results = jnp.where(layout.has_comms, 8.0 * params.result_message_bytes / params.uplink_rate_bit_s, 0.0)
    duration = jnp.max(jnp.where(served, t_fly + t_upload, t_compute + t_results))

    t_hover = duration - jnp.where(params.flight_power_adds_to_hover, 0.0, t_fly)
    uav_cost = params.uav_flying_power_w * t_fly + params.uav_hovering_power_w * t_hover
    starts = state.uav_energy >= uav_cost

    work = jnp.where(
        served,
        params.transmit_power_w * t_upload,
        layout.active_power * t_compute + params.transmit_power_w * t_results,
    )
    drain = jnp.where(layout.has_power, 0.0, layout.standby_power * duration + work)
    after = State(
        battery=jnp.maximum(state.battery - drain, 0.0),
        age=jnp.where(served, 0, state.age + jnp.where(layout.has_comms, 0, 1)),
        uav_position=hover_point,
        uav_energy=state.uav_energy - uav_cost,
        slot=state.slot + 1,
        elapsed=state.elapsed + duration,
    )
    unstarted = replace(state, slot=state.slot + jnp.where(params.count_unfinished_slot, 1, 0))
    after = jax.tree.map(lambda played, kept: jnp.where(starts, played, kept), after, unstarted)
    empty = starts & (after.battery <= 0.0)
    return after, _outcome(params, state, after, starts, served, duration, drain, empty)


def _outcome(
    params: Params,
    before: State,
    after: State,
    starts: Bool[Array, ""],
    served: Bool[Array, " n"],
    duration: Float[Array, ""],
    drain: Float[Array, " n"],
    empty: Bool[Array, " n"],
) -> Outcome:
    """Check for failures after the slot; an empty battery takes precedence over expired data."""
    expired = starts & (after.age >= slots_to_expiry(params))
    cause = jnp.where(
        starts,
        jnp.where(jnp.any(empty), Cause.BATTERY, jnp.where(jnp.any(expired), Cause.DATA_AGE, Cause.NONE)),
        Cause.UAV,
    )
    # Mean power over the slot is drain / duration, so a battery lasts battery / drain of the slot.
    lasts = jnp.where(empty, before.battery / jnp.where(empty, drain, 1.0), jnp.inf)
    first = jnp.where(jnp.any(empty), empty & (lasts <= jnp.min(lasts)), expired)
    return Outcome(
        cause=cause.astype(jnp.int32),
        failed=empty | expired,
        served=served & starts,
        duration=jnp.where(starts, duration, 0.0),
        first_failure=first / jnp.maximum(jnp.sum(first), 1),
    )

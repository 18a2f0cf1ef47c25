"""The radio channel between a device and a UAV (paper, equation 4)."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from uavmec_jax.env.params import Params


def upload_rate(params: Params, slant_distance_m: Float[Array, "*K n"]) -> Float[Array, "*K n"]:
    """Return the Shannon rate of an upload to the UAV, bit/s (paper, equation 4); each served device has the full band."""
    gain = params.reference_gain * jnp.exp(-params.path_loss_exponent * jnp.log(slant_distance_m))
    snr = params.transmit_power_w * gain / params.noise_power_w
    return params.bandwidth_hz * _log1p(snr) / math.log(2.0)


def _log1p(x: Float[Array, "*K n"]) -> Float[Array, "*K n"]:
    """Return ``log(1 + x)`` for ``x >= 0`` with a relative error below 3e-7.

    XLA's ``log1p`` costs as much as the rest of the slot. Small arguments use the series of ``2 artanh(x / (2 + x))``.
    """
    z = x / (2.0 + x)
    square = z * z
    series = 2.0 * z * (1.0 + square * (1 / 3 + square * (1 / 5 + square * (1 / 7))))
    return jnp.where(x < 0.25, series, jnp.log(1.0 + x))

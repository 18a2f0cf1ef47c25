"""The paper's observation: battery fractions and data ages."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params


def observe(params: Params, layout: Layout, state: State) -> Float[Array, "*batch obs_size"]:
    """Return the paper's observation, ``[..., 2n]`` f32.

    Args:
        params: not used; every ``observation_fn`` has these arguments.
        layout: the devices.
        state: one state, or a batch of states of these devices.

    Returns:
        n battery fractions in [0, 1], then n data ages in slots.
    """
    del params
    return jnp.concatenate([state.battery / layout.capacity, state.age.astype(jnp.float32)], axis=-1)


def observation_bounds(
    params: Params, n_devices: int
) -> tuple[Float[np.ndarray, " two_n"], Float[np.ndarray, " two_n"]]:
    """Return the least and the largest values of the paper's observation, ``[2n]`` each.

    Battery fractions are in [0, 1]; ages go from 0 to the limit + 1, or without end where an episode goes on after a failure.

    Args:
        params: those of one scenario, or of a batch of them.
        n_devices: number of devices.
    """
    max_age = np.inf if params.end == "horizon" else float(np.max(params.data_age_limit_slots)) + 1.0
    high = np.concatenate([np.ones(n_devices, np.float32), np.full(n_devices, max_age, np.float32)])
    return np.zeros(2 * n_devices, np.float32), high

"""Small scenarios whose numbers can be worked out by hand."""

import jax
import jax.numpy as jnp

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout, sample_layout
from uavmec_jax.env.params import Params


def three_devices(has_power=(False, False, False), has_comms=(False, False, False), **changes) -> Layout:
    """Return a layout with device 0 at 50 m from the origin, device 1 at 60 m north of it (co-served), device 2 far away."""
    fields = {
        "position": jnp.array([[30.0, 40.0], [30.0, 100.0], [330.0, 440.0]]),
        "device_type": jnp.zeros(3, jnp.int32),
        "task": jnp.zeros(3, jnp.int32),
        "capacity": jnp.array([60_000.0, 60_000.0, 60_000.0]),
        "has_power": jnp.array(has_power),
        "has_comms": jnp.array(has_comms),
        "standby_power": jnp.array([2.0, 3.0, 4.0]),
        "active_power": jnp.array([1.0, 1.5, 2.5]),
        "processing_rate": jnp.array([10_000.0, 10_000.0, 10_000.0]),
    }
    return Layout(**{**fields, **changes})


def mid_life(seed, n, **overrides):
    """Return parameters, a random layout of ``n`` devices and a state in the middle of an episode."""
    params = Params(n_devices=n, **overrides)
    layout = sample_layout(jax.random.key(seed), params, n // 2, n // 3)
    k_battery, k_age, k_position = jax.random.split(jax.random.key(100 + seed), 3)
    state = State(
        battery=layout.capacity * jax.random.uniform(k_battery, (n,), minval=0.2),
        age=jnp.where(layout.has_comms, 0, jax.random.randint(k_age, (n,), 0, 9)),
        uav_position=layout.position[jax.random.randint(k_position, (1,), 0, n)],
        uav_energy=jnp.array([900_000.0]),
        slot=jnp.int32(8),
        elapsed=jnp.float32(4_000.0),
    )
    return params, layout, state

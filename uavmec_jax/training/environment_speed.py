"""Measure the speed of the environment on this machine."""

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Int, Key

from uavmec_jax.env.dynamics import Cause, State, initial_state
from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.scenario import Scenario, advance, auto_reset, draw_volumes, make_scenario


def random_steps(
    scenario: Scenario, state: State, key: Key[Array, ""], steps: int | Int[Array, ""]
) -> tuple[State, Float[Array, ""]]:
    """Take ``steps`` random actions in one scenario with auto-reset, and return the state and the summed reward."""
    n = scenario.layout.capacity.shape[0]

    def step(i: Any, carry: tuple[State, Any]) -> tuple[State, Any]:
        state, total = carry
        uniform = jax.random.uniform(jax.random.fold_in(key, i), (n + 1,))
        action = jnp.minimum((uniform[n] * n).astype(jnp.int32), n - 1)
        after, reward, outcome = advance(scenario, state, action, draw_volumes(scenario.params, uniform[:n]))
        return auto_reset(outcome.cause != Cause.NONE, scenario, after), total + reward

    return jax.lax.fori_loop(0, steps, step, (state, jnp.float32(0)))


def environment_speed(n_layouts: int = 4096, seconds: float = 2.0) -> float:
    """Measure the environment steps per second under random actions, with ``n_layouts`` layouts split over all devices."""
    devices = jax.local_devices()
    n_layouts = -(-n_layouts // len(devices)) * len(devices)
    mesh = Mesh(np.array(devices), ("layouts",))
    keys = jax.random.split(jax.random.key(0), n_layouts)
    scenarios = jax.vmap(lambda key: make_scenario(sample_layout(key, Params(), 8, 8)))(keys)
    states = jax.vmap(lambda s: initial_state(s.params, s.layout))(scenarios)
    split = PartitionSpec("layouts")
    play = jax.jit(
        jax.shard_map(
            jax.vmap(random_steps, in_axes=(0, 0, 0, None)),
            mesh=mesh,
            in_specs=(split, split, split, PartitionSpec()),
            out_specs=split,
            check_vma=False,
        ),
        donate_argnums=1,
    )
    run = partial(play, scenarios)
    states, _ = jax.block_until_ready(run(states, keys, 1))
    chunk, best, deadline = max(1, 400_000 // n_layouts), 0.0, time.perf_counter() + seconds
    while time.perf_counter() < deadline:
        started = time.perf_counter()
        states, _ = jax.block_until_ready(run(states, keys, chunk))
        best = max(best, n_layouts * chunk / (time.perf_counter() - started))
    return best

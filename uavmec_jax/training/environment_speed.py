"""Measure the speed of the environment on this machine."""

import time
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Int, Key

from uavmec_jax.env.dynamics import Cause, State, initial_state
from uavmec_jax.env.fleet import make_depots, make_fleet
from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.scenario import Scenario, advance, auto_reset, draw_volumes, make_scenario


def random_steps(
    scenario: Scenario, state: State, key: Key[Array, ""], steps: int | Int[Array, ""]
) -> tuple[State, Float[Array, ""]]:
    """Take ``steps`` random actions in one scenario with auto-reset, and return the state and the summed reward."""
    n, places = scenario.layout.n_devices, scenario.layout.n_places

    def step(i: Any, carry: tuple[State, Any]) -> tuple[State, Any]:
        state, total = carry
        uniform = jax.random.uniform(jax.random.fold_in(key, i), (n + scenario.layout.n_uavs,))
        action = jnp.minimum((uniform[n:] * places).astype(jnp.int32), places - 1)
        after, reward, outcome = advance(scenario, state, action, draw_volumes(scenario.params, uniform[:n]))
        return auto_reset(outcome.cause != Cause.NONE, scenario, state, after), total + reward

    return jax.lax.fori_loop(0, steps, step, (state, jnp.float32(0)))


def environment_speed(
    n_layouts: int = 4096, seconds: float = 2.0, *, devices: int = 12, uavs: int = 1, depot: bool = False
) -> float:
    """Measure the environment steps per second under random actions, with ``n_layouts`` layouts split over all devices.

    Args:
        n_layouts: number of random layouts; two thirds of the devices have power, and two thirds communication.
        seconds: duration of the measurement.
        devices: devices per layout, as dense as in the paper.
        uavs: UAVs per layout.
        depot: whether there is a depot that swaps batteries, at the origin.
    """
    machine = jax.local_devices()
    n_layouts = -(-n_layouts // len(machine)) * len(machine)
    mesh = Mesh(np.array(machine), ("layouts",))
    keys = jax.random.split(jax.random.key(0), n_layouts)
    scenarios = jax.vmap(lambda key: _random_scenario(key, devices, uavs, depot))(keys)
    states = jax.vmap(lambda s: initial_state(s.params, s.layout))(scenarios)
    states = jax.tree.map(jnp.copy, states)  # full batteries share the layouts' memory, and `states` will be donated
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
    for _ in range(2):  # the second call compiles for states that are spread over the devices
        states, _ = jax.block_until_ready(run(states, keys, 1))
    chunk, best, deadline = max(1, 4_800_000 // (n_layouts * devices * uavs)), 0.0, time.perf_counter() + seconds
    while time.perf_counter() < deadline:
        started = time.perf_counter()
        states, _ = jax.block_until_ready(run(states, keys, chunk))
        best = max(best, n_layouts * chunk / (time.perf_counter() - started))
    return best


def _random_scenario(key: Key[Array, ""], devices: int, uavs: int, depot: bool) -> Scenario:
    """Draw a scenario; its region grows with the number of devices."""
    side = 800.0 * (devices / 12) ** 0.5
    params = Params(n_devices=devices, region_m=(side, side))
    layout = sample_layout(key, params, 2 * devices // 3, 2 * devices // 3)
    depots = make_depots([[0.0, 0.0]]) if depot else None
    fleet = make_fleet(params, uavs, depots) if uavs > 1 else None
    return make_scenario(replace(layout, fleet=fleet, depots=depots), params)

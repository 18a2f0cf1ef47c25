"""Measure the speed of the environment and of training on this machine."""

import time
from collections.abc import Callable
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
from uavmec_jax.studies.population import make_agents, make_algorithm, n_agents, validation_keys
from uavmec_jax.studies.schema import Study
from uavmec_jax.training import host
from uavmec_jax.training.partition import partition_population
from uavmec_jax.training.population import take_padded
from uavmec_jax.training.programs import Programs, make_mesh, put_on_mesh


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


def training_speed(
    study: Study,
    seconds: float,
    *,
    warm_up: int = 2,
    start: int | None = None,
    prepare: Callable[[Any], Any] = lambda state: state,
) -> dict[str, float]:
    """Measure the environment steps per second of training a study's population, shard after shard as in a run.

    Args:
        study: a study of one algorithm.
        seconds: duration of the measurement, for all shards together.
        warm_up: iterations before the clock starts.
        start: iteration at which the clock starts; by default where the warm-up ended.
        prepare: applied to the state after the warm-up, e.g. to fill a replay buffer.

    Returns:
        ``steps_per_second`` and ``compile_seconds``.
    """
    algorithm, n = make_algorithm(study), n_agents(study)
    assert algorithm is not None
    partition = partition_population(n, algorithm.agent_bytes, host.free_memory())
    mesh = make_mesh(partition.devices)
    population = (make_agents(study), validation_keys(study))
    started = time.perf_counter()
    programs = Programs.compile(algorithm, mesh, take_padded(population, 0, partition.shard_size))
    compile_seconds = time.perf_counter() - started
    chunk, rates = max(1, 1000 // algorithm.steps_per_iteration), []
    for shard in range(partition.shards):
        agents, _ = put_on_mesh(mesh, take_padded(population, shard * partition.shard_size, partition.shard_size))
        state = prepare(programs.update(agents, programs.init(agents), np.int32(0), np.int32(warm_up)))
        first = warm_up if start is None else start

        def train_chunk(state: Any, first: int, agents: Any = agents) -> Any:
            return jax.block_until_ready(programs.update(agents, state, np.int32(first), np.int32(first + chunk)))

        state = train_chunk(state, first)  # warms the caches
        chunks, started = 0, time.perf_counter()
        while chunks == 0 or time.perf_counter() - started < seconds / partition.shards:
            chunks += 1
            state = train_chunk(state, first + chunks * chunk)
        steps = chunks * chunk * algorithm.steps_per_iteration * min(partition.shard_size, n)
        rates.append(steps / (time.perf_counter() - started))
    return {"steps_per_second": float(np.mean(rates)), "compile_seconds": compile_seconds}

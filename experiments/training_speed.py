"""Measure the speed of training a population, shard after shard as in a run."""

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from uavmec_jax.studies.population import make_agents, make_algorithm, n_agents, validation_keys
from uavmec_jax.studies.schema import Study
from uavmec_jax.training import host
from uavmec_jax.training.partition import partition_population
from uavmec_jax.training.population import take_padded
from uavmec_jax.training.programs import Programs, make_mesh, put_on_mesh


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

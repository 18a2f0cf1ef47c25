"""Train the shards of a population on Ray: each of them is a task on some node."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.cluster.connection import Cluster
from uavmec_jax.cluster.tasks import Task, TaskError, TaskRun
from uavmec_jax.errors import StudyError, UserError
from uavmec_jax.training.chunks import Validation
from uavmec_jax.training.machine import WorkerOptions
from uavmec_jax.training.partition import Partition
from uavmec_jax.training.population import take_padded
from uavmec_jax.training.to_host import from_host, to_host
from uavmec_jax.training.trained_shard import TrainedShard
from uavmec_jax.training.training import Trainer

_PROGRAMS = 8
"""Shapes of shards whose programs a worker process keeps."""


@dataclass(frozen=True)
class SavedShard:
    """A shard between two chunks, away from its devices.

    Attributes:
        chunks_done: number of finished chunks.
        arrays: see :meth:`Training.arrays`.
        best_scores: best validation score of each agent so far, padding included.
        last_scores: last validation score of each agent, padding included.
    """

    chunks_done: int
    arrays: dict[str, np.ndarray]
    best_scores: Float[np.ndarray, " B"]
    last_scores: Float[np.ndarray, " B"]


@dataclass(frozen=True)
class ShardProgram:
    """What a worker compiles to train the shards of a population; it compiles equal programs once.

    Attributes:
        algorithm: name of the algorithm.
        spec: its static settings.
        validation: when and how to validate.
        partition: the shape of the shards, as the partition of one.
    """

    algorithm: str
    spec: Any
    validation: Validation
    partition: Partition

    @classmethod
    def of(cls, algorithm: Algorithm, validation: Validation, partition: Partition) -> "ShardProgram":
        """Describe the program of an algorithm from :data:`ALGORITHMS`."""
        return cls(algorithm.name, algorithm.spec, validation, replace(partition, shards=1))


@dataclass
class PopulationOnRay:
    """A population whose shards are trained on a cluster, and in between are kept by this process.

    Attributes:
        cluster: the cluster.
        program: what trains a shard.
        agents: number of agents, without padding.
        population: reference to the agents and the keys of their validations, on the host.
        saved: reference to where each shard has got; ``None`` before its first chunk.
    """

    cluster: Cluster
    program: ShardProgram
    agents: int
    population: Any
    saved: list[Any] = field(default_factory=list)

    @classmethod
    def of(
        cls,
        cluster: Cluster,
        program: ShardProgram,
        agents: Agent,
        keys: Key[Array, "A D"],
        saved: list[Any] | None = None,
    ) -> "PopulationOnRay":
        """Hand a population to the cluster.

        Args:
            cluster: the cluster.
            program: what trains a shard.
            agents: leaves ``[A, ...]``.
            keys: keys of their validations.
            saved: references to ``(chunks_done, arrays)`` of each shard; by default none has begun.
        """
        n = keys.shape[0]
        shards = -(-n // program.partition.shard_size)
        return cls(cluster, program, n, cluster.ray.put(to_host((agents, keys))), saved or [None] * shards)

    def train(self, on_shard: Callable[[int], None] = lambda finished: None) -> list[TrainedShard]:
        """Train all shards to the end and return their results; this, or :meth:`train_until`, can be called once.

        Args:
            on_shard: called with the number of finished shards after each of them.

        Raises:
            StudyError: a shard failed for good, or the connection to the cluster is lost.
        """
        return self._run(None, on_shard)

    def train_until(self, chunk: int, on_shard: Callable[[int], None] = lambda finished: None) -> list[SavedShard]:
        """Train all shards until so many chunks are done, fewer than all, and return where they have got.

        Args:
            chunk: number of chunks of the whole training.
            on_shard: called with the number of shards that have got there after each of them.

        Raises:
            StudyError: a shard failed for good, or the connection to the cluster is lost.
        """
        return self._run(chunk, on_shard)

    def _run(self, until: int | None, on_shard: Callable[[int], None]) -> list[Any]:
        shards = len(self.saved)
        results: dict[int, Any] = {}
        worker = WorkerOptions.of(self.cluster)

        def task_of(number: int) -> Task:
            def arguments() -> tuple[Any, ...]:
                return worker, self.program, self.population, self.agents, number, self.saved[number], until

            return Task(number, train_shard, arguments)

        # closing: an error here must cancel the other shards now, not when its traceback is let go
        with closing(TaskRun(self.cluster).results(map(task_of, range(shards)))) as outcomes:
            for number, outcome in outcomes:
                if isinstance(outcome, TaskError):
                    raise _failure(number, shards, outcome) from outcome.cause
                results[number], self.saved[number] = outcome, None
                on_shard(len(results))
        return [results[number] for number in range(shards)]


def _failure(number: int, shards: int, failed: TaskError) -> UserError:
    """Return the error of a shard that failed for good, in one line."""
    if isinstance(failed.cause, UserError):
        return failed.cause
    return StudyError(f"shard {number} of {shards} failed on the Ray cluster: {failed.error.splitlines()[0]}")


@dataclass(frozen=True)
class _Example:
    """A shard's agents and the keys of their validations; equal to every other shard of the same shape."""

    members: Any = field(compare=False)
    shape: tuple[Any, ...]

    @classmethod
    def of(cls, members: Any) -> "_Example":
        leaves, structure = jax.tree.flatten(members)
        return cls(members, (structure, *((leaf.shape, leaf.dtype) for leaf in leaves)))


def train_shard(
    worker: WorkerOptions,
    program: ShardProgram,
    population: Any,
    agents: int,
    number: int,
    saved: tuple[int, dict[str, np.ndarray]] | None,
    until: int | None,
) -> SavedShard | TrainedShard:
    """Train a shard of a population of so many agents; this runs on a node."""
    size = program.partition.shard_size
    with worker.prepared():
        members = from_host(take_padded(population, number * size, size))
        training = _trainer(program, _Example.of(members)).start(*members)
        if saved is not None:
            training.restore(*saved)
        for _ in training.run(until):
            pass
        if training.finished:
            return training.result(min(size, agents - number * size))
        return SavedShard(training.chunks_done, training.arrays(), training.best_scores, training.scores[-1])


@lru_cache(maxsize=_PROGRAMS)
def _trainer(program: ShardProgram, example: _Example) -> Trainer:
    """Compile the programs for shards of one shape."""
    algorithm, (agents, keys) = ALGORITHMS[program.algorithm].bind(program.spec), example.members
    return Trainer.compile(algorithm, agents, keys, program.validation, program.partition)

"""Many agents in lockstep, shard after shard."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.training.partition import Partition
from uavmec_jax.training.training import TrainedShard, Trainer, Validation


@dataclass(frozen=True)
class Progress:
    """How far a population is, reported after every chunk.

    Attributes:
        shard: number of the shard in training.
        steps: environment steps made by the whole population.
        total_steps: of a whole training.
        mean_episode_length: of the training episodes that ended in the chunk, slots.
    """

    shard: int
    steps: int
    total_steps: int
    mean_episode_length: float


def take_padded(tree: Any, first: int, size: int) -> Any:
    """Take leaves ``[size, ...]`` from ``first`` on; past the end the last entry is repeated, to keep the shape."""
    n = jax.tree.leaves(tree)[0].shape[0]
    places = np.minimum(np.arange(first, first + size), n - 1)
    return jax.tree.map(lambda leaf: leaf[places], tree)


def train_population(
    algorithm: Algorithm,
    agents: Agent,
    validation_keys: Key[Array, "A D"],
    *,
    validation: Validation,
    partition: Partition,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Iterator[TrainedShard]:
    """Train a population shard by shard, yielding each shard when it is finished.

    Args:
        algorithm: what trains.
        agents: the population, leaves ``[A, ...]``.
        validation_keys: ``[A, validation.draws]`` volume draws for the validations.
        validation: the validations during training.
        partition: from :func:`uavmec_jax.training.partition.partition_population`.
        on_progress: called after every chunk.
    """
    n, size = validation_keys.shape[0], partition.shard_size
    example_agents, example_keys = take_padded((agents, validation_keys), 0, size)
    trainer = Trainer.compile(algorithm, example_agents, example_keys, validation, partition)
    for shard in range(partition.shards):
        first = shard * size
        members = min(size, n - first)
        training = trainer.start(*take_padded((agents, validation_keys), first, size))
        for _ in training.run():
            done = first * algorithm.total_steps + members * training.steps
            on_progress(Progress(shard, done, n * algorithm.total_steps, training.mean_episode_length))
        yield training.result(members)

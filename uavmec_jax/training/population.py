"""The training of a population: its agents run in lockstep, shard after shard."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.training.chunks import Validation
from uavmec_jax.training.partition import Partition
from uavmec_jax.training.trained_shard import TrainedShard
from uavmec_jax.training.training import Trainer


@dataclass(frozen=True)
class Progress:
    """The progress of a population, reported after every chunk.

    Attributes:
        shard: index of the shard in training.
        steps: environment steps made by all agents of the population together.
        total_steps: the same at the end of the training.
        mean_episode_length: mean length of the training episodes that ended in the chunk, slots.
        detail: on a cluster, where the shards run.
    """

    shard: int
    steps: int
    total_steps: int
    mean_episode_length: float
    detail: str = ""


def take_padded(tree: Any, first: int, size: int) -> Any:
    """Return the entries ``first`` to ``first + size`` of every leaf; past the end, the last entry is repeated."""
    n = jax.tree.leaves(tree)[0].shape[0]
    indices = np.minimum(np.arange(first, first + size), n - 1)
    return jax.tree.map(lambda leaf: leaf[indices], tree)


def train_population(
    algorithm: Algorithm,
    agents: Agent,
    validation_keys: Key[Array, "A D"],
    *,
    validation: Validation,
    partition: Partition,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Iterator[TrainedShard]:
    """Train a population shard by shard and yield the result of each shard as soon as it is finished.

    Args:
        algorithm: the learning algorithm.
        agents: the population, leaves ``[A, ...]``.
        validation_keys: draws of the task volumes for the validations, ``D = validation.draws`` for each agent.
        validation: when and how to validate.
        partition: from :func:`uavmec_jax.training.partition.partition_population`.
        on_progress: called after every chunk.
    """
    n, size = validation_keys.shape[0], partition.shard_size
    example_agents, example_keys = take_padded((agents, validation_keys), 0, size)
    trainer = Trainer.compile(algorithm, example_agents, example_keys, validation, partition)
    for shard in range(partition.shards):
        first = shard * size
        n_members = min(size, n - first)
        training = trainer.start(*take_padded((agents, validation_keys), first, size))
        for _ in training.run():
            steps = first * algorithm.total_steps + n_members * training.steps
            on_progress(Progress(shard, steps, n * algorithm.total_steps, training.mean_episode_length))
        yield training.result(n_members)

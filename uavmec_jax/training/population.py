"""Many agents in lockstep, block after block."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.training.partition import Blocks
from uavmec_jax.training.training import TrainedBlock, Trainer, Validation


@dataclass(frozen=True)
class Progress:
    """One line of news from the host loop, after every chunk."""

    block: int
    steps: int
    """Environment steps made by the whole population."""
    of_steps: int
    mean_length: float
    """Mean length of the training episodes that ended in the chunk, slots."""


def take(tree: Any, first: int, size: int) -> Any:
    """Leaves ``[size, ...]`` from ``first`` on; past the end the last one is repeated, to keep the shape."""
    n = jax.tree.leaves(tree)[0].shape[0]
    places = np.minimum(np.arange(first, first + size), n - 1)
    return jax.tree.map(lambda leaf: leaf[places], tree)


def train(
    algorithm: Algorithm,
    agents: Agent,
    validation_keys: Key[Array, "A D"],
    *,
    validation: Validation,
    blocks: Blocks,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Iterator[TrainedBlock]:
    """Train a population block by block, yielding each block as it is finished.

    Args:
        algorithm: what trains.
        agents: the population, leaves ``[A, ...]``.
        validation_keys: ``[A, validation.draws]`` volume draws for the looks.
        validation: the looks during training.
        blocks: from :func:`uavmec_jax.training.partition.plan_blocks`.
        on_progress: told after every chunk.
    """
    n = validation_keys.shape[0]
    members, keys = take((agents, validation_keys), 0, blocks.size)
    trainer = Trainer.compile(algorithm, members, keys, validation, blocks)
    for block in range(blocks.count):
        first = block * blocks.size
        real = min(blocks.size, n - first)
        training = trainer.start(*take((agents, validation_keys), first, blocks.size))
        while not training.finished:
            training.advance()
            done = first * algorithm.total_steps + real * training.steps
            on_progress(Progress(block, done, n * algorithm.total_steps, training.mean_length))
        yield training.trained(real)

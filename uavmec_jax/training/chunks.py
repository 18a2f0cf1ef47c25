"""The chunks of a training, and the validations between them."""

import itertools
from dataclasses import dataclass

import numpy as np

from uavmec_jax.agents.algorithm import Algorithm


@dataclass(frozen=True)
class Validation:
    """When and how the greedy policies are validated during training.

    Attributes:
        every: environment steps of one agent between validations, rounded down to whole iterations.
        draws: number of episodes per validation, each with its own draw of the task volumes.
        chunks: number of jitted chunks between validations, for the progress display and the training curve.
    """

    every: int = 10_000
    draws: int = 8
    chunks: int = 4


@dataclass(frozen=True)
class Chunk:
    """Iterations ``first <= i < last`` of a training, and whether a validation follows."""

    first: int
    last: int
    validates: bool


def chunks_of(algorithm: Algorithm, validation: Validation) -> list[Chunk]:
    """Return the chunks of a whole training; the last one ends with a validation."""
    every = max(validation.every // algorithm.steps_per_iteration, 1)
    chunks = []
    for start in range(0, algorithm.iterations, every):
        stop = min(start + every, algorithm.iterations)
        edges = np.linspace(start, stop, min(validation.chunks, stop - start) + 1).astype(int)
        chunks += [Chunk(int(first), int(last), int(last) == stop) for first, last in itertools.pairwise(edges)]
    return chunks

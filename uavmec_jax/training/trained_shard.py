"""The result of training one shard of agents."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from uavmec_jax.agents.networks import Weights


@dataclass(frozen=True)
class TrainedShard:
    """Weights and curves of the ``B`` agents of a shard, without padding, as NumPy arrays.

    Attributes:
        last: weights after the last step, leaves ``[B, ...]``.
        best: weights with the best validation score, leaves ``[B, ...]``.
        best_step: environment step of the best validation.
        best_score: its score: mean lifetime in slots, or mean return if the reward also counts traffic.
        diverged_at: environment step at which an agent was frozen, -1 if it has not diverged.
        chunk_steps: environment steps of one agent at the end of each chunk.
        episode_length: mean length of the training episodes that ended in each chunk, slots; NaN if none did.
        validation_steps: environment steps of one agent at each validation.
        validation: score of each validation.
        seconds: wall time by activity: ``train``, ``validate``.
    """

    last: Weights
    best: Weights
    best_step: Int[np.ndarray, " B"]
    best_score: Float[np.ndarray, " B"]
    diverged_at: Int[np.ndarray, " B"]
    chunk_steps: Int[np.ndarray, " C"]
    episode_length: Float[np.ndarray, "B C"]
    validation_steps: Int[np.ndarray, " V"]
    validation: Float[np.ndarray, "B V"]
    seconds: dict[str, float]

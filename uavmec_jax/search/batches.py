"""A batch of trials in training, between two rungs: in this process, or on Ray."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Float, Int, Key

from uavmec_jax.agents.algorithm import Agent
from uavmec_jax.agents.networks import Weights
from uavmec_jax.cluster.connection import Cluster
from uavmec_jax.training.chunks import Chunk
from uavmec_jax.training.on_ray import PopulationOnRay, SavedShard, ShardProgram
from uavmec_jax.training.population import take_padded
from uavmec_jax.training.regroup import regroup, regroup_arrays
from uavmec_jax.training.trained_shard import TrainedShard
from uavmec_jax.training.training import Trainer, Training


@runtime_checkable
class Batch(Protocol):
    """The population of a batch, trained from rung to rung. Agents are counted without padding, in the order of ``keep``."""

    def train_until(self, chunk: int, on_share: Callable[[float], None]) -> None:
        """Train until so many chunks of the whole training are done; ``on_share`` gets the share of all chunks done."""

    def scores(self, which: str) -> Float[np.ndarray, " A"]:
        """Return the validation scores of the agents, padding included: ``best`` for the best so far, ``last``."""
        raise NotImplementedError

    def keep(self, members: Int[np.ndarray, " members"]) -> None:
        """Go on with some of the agents only, given by their indices."""

    def weights(self, which: str) -> Weights:
        """Return the ``best`` or the ``last`` weights of the agents, whose training is finished."""
        raise NotImplementedError


class BatchInProcess:
    """A batch that is trained in this process, one shard after the other."""

    def __init__(self, trainer: Trainer, agents: Agent, keys: Key[Array, "A D"]) -> None:
        """Start the training."""
        partition, size = trainer.partition, trainer.partition.shard_size
        self._agents = keys.shape[0]
        self._trainings: list[Training] = [
            trainer.start(*take_padded((agents, keys), shard * size, size)) for shard in range(partition.shards)
        ]

    def train_until(self, chunk: int, on_share: Callable[[float], None]) -> None:
        """Train until so many chunks of the whole training are done."""
        total = len(self._trainings) * len(self._trainings[0].trainer.chunks)
        for training in self._trainings:
            for _ in training.run(until=chunk):
                on_share(sum(shard.chunks_done for shard in self._trainings) / total)

    def scores(self, which: str) -> Float[np.ndarray, " A"]:
        """Return the best validation scores so far, or the last ones."""
        scores = [one.best_scores if which == "best" else one.scores[-1] for one in self._trainings]
        return np.concatenate(scores)

    def keep(self, members: Int[np.ndarray, " members"]) -> None:
        """Go on with some of the agents."""
        self._agents, self._trainings = len(members), regroup(self._trainings, members)

    def weights(self, which: str) -> Weights:
        """Return the best or the last weights."""
        size = self._trainings[0].trainer.partition.shard_size
        pieces = [one.weights(min(size, self._agents - k * size))[which] for k, one in enumerate(self._trainings)]
        return _concatenate(pieces)


@dataclass
class BatchOnRay:
    """A batch whose shards are tasks on a cluster from rung to rung; between rungs this process regroups them.

    Attributes:
        cluster: the cluster.
        program: what trains a shard.
        chunks: the chunks of the whole training.
        agents: leaves ``[A, ...]``.
        keys: keys of their validations.
    """

    cluster: Cluster
    program: ShardProgram
    chunks: list[Chunk]
    agents: Agent
    keys: Key[Array, "A D"]
    _chunks_done: int = 0
    _begun: list[Any] | None = None
    _saved: list[SavedShard] | None = None
    _trained: list[TrainedShard] | None = None

    def train_until(self, chunk: int, on_share: Callable[[float], None]) -> None:
        """Train until so many chunks of the whole training are done."""
        population = PopulationOnRay.of(self.cluster, self.program, self.agents, self.keys, self._begun)
        shards, before, self._begun = len(population.saved), self._chunks_done, None

        def on_shard(finished: int) -> None:
            on_share((before + (chunk - before) * finished / shards) / len(self.chunks))

        if chunk < len(self.chunks):
            self._saved = population.train_until(chunk, on_shard)
        else:
            self._saved, self._trained = None, population.train(on_shard)
        self._chunks_done = chunk

    def scores(self, which: str) -> Float[np.ndarray, " A"]:
        """Return the best validation scores so far, or the last ones."""
        if self._trained is not None:
            return np.concatenate(
                [shard.best_score if which == "best" else shard.validation[:, -1] for shard in self._trained]
            )
        assert self._saved is not None
        return np.concatenate([shard.best_scores if which == "best" else shard.last_scores for shard in self._saved])

    def keep(self, members: Int[np.ndarray, " members"]) -> None:
        """Go on with some of the agents."""
        assert self._saved is not None
        saved, self._saved = [shard.arrays for shard in self._saved], None
        self.agents, self.keys = jax.tree.map(lambda leaf: leaf[members], (self.agents, self.keys))
        self._begun = [
            self.cluster.ray.put((self._chunks_done, arrays))
            for arrays in regroup_arrays(saved, members, self.program.partition)
        ]

    def weights(self, which: str) -> Weights:
        """Return the best or the last weights."""
        assert self._trained is not None
        return _concatenate([getattr(shard, which) for shard in self._trained])


def _concatenate(pieces: list[Weights]) -> Weights:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)

"""The training of one shard of agents in lockstep: a host loop over jitted chunks whose buffers are donated.

Between any two chunks, a training can be saved and resumed. A shard consists of groups of equal size, each of which one
program trains on one device. If there are fewer devices than groups, the groups take turns within every chunk. The results
are therefore the same, to the bit, on any number of devices.
"""

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int, Key

from uavmec_jax.agents.algorithm import Agent, Algorithm, AlgorithmState
from uavmec_jax.agents.networks import Weights
from uavmec_jax.training.chunks import Chunk, Validation, chunks_of
from uavmec_jax.training.partition import Partition
from uavmec_jax.training.programs import Best, Programs, initial_best, make_mesh, put_on_mesh
from uavmec_jax.training.trained_shard import TrainedShard


@dataclass(frozen=True)
class Trainer:
    """The compiled programs that train shards of one shape on the local devices.

    Attributes:
        algorithm: the learning algorithm.
        validation: when and how to validate.
        partition: the partition of the population.
        mesh: the devices that train a shard.
        programs: compiled for one group per device.
        compile_seconds: duration of their compilation.
    """

    algorithm: Algorithm
    validation: Validation
    partition: Partition
    mesh: Mesh
    programs: Programs
    compile_seconds: float

    @classmethod
    def compile(
        cls, algorithm: Algorithm, agents: Agent, keys: Key[Array, "B D"], validation: Validation, partition: Partition
    ) -> "Trainer":
        """Compile the programs for shards that have the shapes of a given one.

        Args:
            algorithm: the learning algorithm.
            agents: the agents of a shard, leaves ``[B, ...]``.
            keys: keys of their validations.
            validation: when and how to validate.
            partition: the partition of the population.
        """
        started = time.perf_counter()
        mesh = make_mesh(partition.devices)
        size = partition.group_size * mesh.size
        programs = Programs.compile(algorithm, mesh, jax.tree.map(lambda leaf: leaf[:size], (agents, keys)))
        return cls(algorithm, validation, partition, mesh, programs, time.perf_counter() - started)

    def start(self, agents: Agent, keys: Key[Array, "B D"]) -> "Training":
        """Return the training of a shard before its first step, from its agents and the keys of their validations."""
        size = self.partition.group_size * self.mesh.size
        batches = []
        for first in range(0, self.partition.shard_size, size):
            batch = jax.tree.map(lambda leaf, first=first: leaf[first : first + size], (agents, keys))
            batch_agents, batch_keys = put_on_mesh(self.mesh, batch)
            state = self.programs.init(batch_agents)
            batches.append(GroupBatch(batch_agents, batch_keys, state, initial_best(state)))
        return Training(self, batches)

    @cached_property
    def chunks(self) -> list[Chunk]:
        """The chunks of a whole training; the last one ends with a validation."""
        return chunks_of(self.algorithm, self.validation)


@dataclass
class GroupBatch:
    """The groups of a shard that train at the same time, one per device; leaves ``[devices * group_size, ...]``.

    Attributes:
        agents: the agents.
        keys: keys of their validations.
        state: the algorithm's state.
        best: the weights with the best validation score so far.
    """

    agents: Agent
    keys: Key[Array, "B D"]
    state: AlgorithmState
    best: Best


@dataclass
class Training:
    """A shard in training, between two chunks.

    Attributes:
        trainer: the compiled programs.
        group_batches: the agents and their states.
        chunks_done: number of finished chunks.
        consistent: ``False`` during a chunk, whose buffers are donated, so that nothing can be saved.
        episode_slots: for every chunk, the total length of the training episodes that ended in it, slots.
        episodes: for every chunk, the number of these episodes.
        scores: for every validation, its score.
        seconds: wall time by activity.
    """

    trainer: Trainer
    group_batches: list[GroupBatch]
    chunks_done: int = 0
    consistent: bool = True
    episode_slots: list[Int[np.ndarray, " B"]] = field(default_factory=list)
    episodes: list[Int[np.ndarray, " B"]] = field(default_factory=list)
    scores: list[Float[np.ndarray, " B"]] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=lambda: {"train": 0.0, "validate": 0.0})

    @property
    def finished(self) -> bool:
        """Whether all chunks are done."""
        return self.chunks_done == len(self.trainer.chunks)

    @property
    def validated(self) -> bool:
        """Whether the last chunk ended with a validation."""
        return self.chunks_done > 0 and self.trainer.chunks[self.chunks_done - 1].validates

    @property
    def steps(self) -> int:
        """Environment steps that each agent has made so far."""
        if not self.chunks_done:
            return 0
        return self.trainer.chunks[self.chunks_done - 1].last * self.trainer.algorithm.steps_per_iteration

    @property
    def mean_episode_length(self) -> float:
        """Mean length of the training episodes that ended in the last chunk, slots."""
        return float(self.episode_slots[-1].sum() / max(self.episodes[-1].sum(), 1))

    @property
    def best_scores(self) -> Float[np.ndarray, " B"]:
        """Best validation score of each agent so far, padding included."""
        return _concatenate(batch.best.score for batch in self.group_batches)

    def run(self, until: int | None = None) -> Iterator[None]:
        """Train chunk after chunk and yield after every chunk. This is the host loop of every training.

        Args:
            until: number of chunks of the whole training after which to stop; by default all of them.
        """
        until = len(self.trainer.chunks) if until is None else until
        while self.chunks_done < until:
            self._advance()
            yield

    def _advance(self) -> None:
        """Train one more chunk, and validate if it ends with a validation."""
        chunk, programs = self.trainer.chunks[self.chunks_done], self.trainer.programs
        tick, self.consistent = time.perf_counter(), False
        for batch in self.group_batches:
            batch.state = programs.update(batch.agents, batch.state, np.int32(chunk.first), np.int32(chunk.last))
        self.episode_slots.append(_concatenate(batch.state.episode_slots for batch in self.group_batches))
        self.episodes.append(_concatenate(batch.state.episodes for batch in self.group_batches))
        self.seconds["train"] += time.perf_counter() - tick
        self.chunks_done += 1
        if chunk.validates:
            self._validate()
        self.consistent = True

    def _validate(self) -> None:
        """Validate the greedy policies of all agents."""
        tick, scores, step = time.perf_counter(), [], np.int32(self.steps)
        for batch in self.group_batches:
            score, batch.best = self.trainer.programs.validate(
                batch.agents, batch.keys, batch.state.policy_weights, batch.best, step
            )
            scores.append(score)
        self.scores.append(_concatenate(scores))
        self.seconds["validate"] += time.perf_counter() - tick

    def arrays(self) -> dict[str, np.ndarray]:
        """Return everything that changes during training, by name and group by group. On a CPU it is not copied."""
        curves = {"episode_slots": self.episode_slots, "episodes": self.episodes, "scores": self.scores}
        named = {f"curves/{name}": np.stack(values) for name, values in curves.items() if values}
        for number, batch in enumerate(self.group_batches):
            for path, leaf in jax.tree.leaves_with_path((batch.state, batch.best)):
                pieces = sorted(leaf.addressable_shards, key=lambda piece: piece.index[0].start or 0)
                for device, piece in enumerate(pieces):
                    named[self._name(number, device, path)] = np.asarray(piece.data)
        return named

    def restore(self, chunks_done: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore the training as it was after ``chunks_done`` chunks.

        Args:
            chunks_done: number of finished chunks.
            arrays: what :meth:`arrays` returned then.

        Raises:
            ValueError: the arrays are those of another training.
        """
        if not 0 <= chunks_done <= len(self.trainer.chunks):
            raise ValueError(f"chunks_done is {chunks_done}; the training has {len(self.trainer.chunks)} chunks")
        validations = sum(chunk.validates for chunk in self.trainer.chunks[:chunks_done])
        agents = self.trainer.partition.shard_size
        for name, kind, count in (
            ("episode_slots", "i", chunks_done),
            ("episodes", "i", chunks_done),
            ("scores", "f", validations),
        ):
            curve = arrays.get(f"curves/{name}") if count else np.empty((0, agents), kind)
            if curve is None or (curve.shape, curve.dtype.kind) != ((count, agents), kind):
                raise ValueError(f"curves/{name} is missing, or not {count} x {agents} numbers")
            setattr(self, name, list(curve))
        for number, batch in enumerate(self.group_batches):

            def leaf_of(path: Any, old: Any, number: int = number) -> Any:
                shape, pieces = old.sharding.shard_shape(old.shape), []
                for place, device in enumerate(self.trainer.mesh.devices):
                    name = self._name(number, place, path)
                    piece = arrays.get(name)
                    if piece is None or (piece.shape, piece.dtype) != (shape, old.dtype):
                        raise ValueError(f"{name} is missing, or not {old.dtype} {list(shape)}")
                    pieces.append(jax.device_put(piece, device, may_alias=False))
                leaf = jax.make_array_from_single_device_arrays(old.shape, old.sharding, pieces)
                old.delete()  # a replay buffer is large: never hold two whole copies
                return leaf

            batch.state, batch.best = jax.tree.map_with_path(leaf_of, (batch.state, batch.best))
        self.chunks_done = chunks_done

    def _name(self, batch: int, device: int, path: Any) -> str:
        """Return the name of a leaf of one group, which is trained on the given device of the mesh."""
        group = batch * self.trainer.mesh.size + device
        return f"{group}/{jax.tree_util.keystr(path, simple=True, separator='/')}"

    def weights(self, n_agents: int) -> dict[str, Weights]:
        """Return the ``best`` and the ``last`` weights so far of the first ``n_agents`` agents, on the host."""
        return {
            "best": _gather([batch.best.weights for batch in self.group_batches], n_agents),
            "last": _gather([batch.state.policy_weights for batch in self.group_batches], n_agents),
        }

    def result(self, n_agents: int) -> TrainedShard:
        """Return the result of the first ``n_agents`` agents; the others are padding."""
        chunks, per_iteration = self.trainer.chunks, self.trainer.algorithm.steps_per_iteration
        slots, counts = np.stack(self.episode_slots, 1)[:n_agents], np.stack(self.episodes, 1)[:n_agents]
        return TrainedShard(
            **self.weights(n_agents),
            best_step=_gather([batch.best.step for batch in self.group_batches], n_agents),
            best_score=_gather([batch.best.score for batch in self.group_batches], n_agents),
            diverged_at=_gather([batch.state.diverged_at for batch in self.group_batches], n_agents),
            chunk_steps=np.array([chunk.last * per_iteration for chunk in chunks]),
            episode_length=np.where(counts > 0, slots / np.maximum(counts, 1), np.nan).astype(np.float32),
            validation_steps=np.array([chunk.last * per_iteration for chunk in chunks if chunk.validates]),
            validation=np.stack(self.scores, 1)[:n_agents],
            seconds=self.seconds,
        )


def _concatenate(leaves: Iterable[Array]) -> np.ndarray:
    """Concatenate the leaves of group batches on the host."""
    return np.concatenate([np.asarray(leaf) for leaf in leaves])


def _gather(trees: list[Any], n_agents: int) -> Any:
    """Concatenate the trees of group batches on the host, leaf by leaf, and keep the first ``n_agents`` entries."""
    return jax.tree.map(lambda *leaves: _concatenate(leaves)[:n_agents], *trees)

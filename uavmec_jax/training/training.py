"""The training of one shard of agents in lockstep: a host loop over jitted chunks whose buffers are donated.

Between any two chunks a training can be saved and resumed. A shard consists of groups of equal size, each trained by one
program on one device. The local devices share the groups; where there are fewer devices than groups, the groups take turns
within every chunk. So the results are the same to the bit on one device, two or four.
"""

import itertools
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Key

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.training.partition import Partition
from uavmec_jax.training.programs import Best, Programs, initial_best, make_mesh, put_on_mesh


@dataclass(frozen=True)
class Validation:
    """When and how the greedy policy is validated during training.

    Attributes:
        every: environment steps of one agent between validations, rounded to whole iterations.
        draws: volume draws per validation.
        chunks: jitted chunks per validation, for the progress display and the training curve.
    """

    every: int = 10_000
    draws: int = 8
    chunks: int = 4


@dataclass(frozen=True)
class TrainedShard:
    """What the training of one shard leaves; NumPy arrays, ``B`` the agents of the shard without padding.

    Attributes:
        last: weights after the last step, leaves ``[B, ...]``.
        best: weights of the best validation, leaves ``[B, ...]``.
        best_step: ``[B]`` environment step of the best validation.
        best_score: ``[B]`` its score: mean lifetime in slots, or, of agents that are paid for traffic, mean return.
        diverged_at: ``[B]`` step at which an agent was frozen, -1 if it was not.
        chunk_steps: ``[C]`` environment steps of one agent at the end of each chunk.
        episode_length: ``[B, C]`` mean length of the training episodes that ended in each chunk (NaN if none did).
        validation_steps: ``[V]`` environment steps of one agent at each validation.
        validation: ``[B, V]`` score of each validation.
        seconds: wall time by activity: ``train``, ``validate``.
    """

    last: Any
    best: Any
    best_step: np.ndarray
    best_score: np.ndarray
    diverged_at: np.ndarray
    chunk_steps: np.ndarray
    episode_length: np.ndarray
    validation_steps: np.ndarray
    validation: np.ndarray
    seconds: dict[str, float]


@dataclass(frozen=True)
class Chunk:
    """Iterations ``first <= i < last`` of a training, and whether a validation follows."""

    first: int
    last: int
    validates: bool


@dataclass(frozen=True)
class Trainer:
    """The compiled programs that train shards of one shape on the local devices.

    Attributes:
        algorithm: what trains.
        validation: the validations during training.
        partition: how the population is cut.
        mesh: the devices that share a shard's groups.
        programs: for as many groups as there are devices.
        compile_seconds: time that compiling them took.
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
        """Compile for shards like the given one: its agents, leaves ``[B, ...]``, and their validation draws."""
        started = time.perf_counter()
        mesh = make_mesh(partition.devices)
        size = partition.group_size * mesh.size
        programs = Programs.compile(algorithm, mesh, jax.tree.map(lambda leaf: leaf[:size], (agents, keys)))
        return cls(algorithm, validation, partition, mesh, programs, time.perf_counter() - started)

    def start(self, agents: Agent, keys: Key[Array, "B D"]) -> "Training":
        """Return a shard before its first step."""
        size = self.partition.group_size * self.mesh.size
        batches = []
        for first in range(0, self.partition.shard_size, size):
            here = slice(first, first + size)
            members, draws = put_on_mesh(self.mesh, jax.tree.map(lambda leaf, here=here: leaf[here], (agents, keys)))
            state = self.programs.init(members)
            batches.append(GroupBatch(members, draws, state, initial_best(state)))
        return Training(self, batches)

    @cached_property
    def chunks(self) -> list[Chunk]:
        """The chunks of a whole training; the last one always ends with a validation."""
        every = max(self.validation.every // self.algorithm.steps_per_iteration, 1)
        chunks = []
        for start in range(0, self.algorithm.iterations, every):
            stop = min(start + every, self.algorithm.iterations)
            edges = np.linspace(start, stop, min(self.validation.chunks, stop - start) + 1).astype(int)
            chunks += [Chunk(int(first), int(last), int(last) == stop) for first, last in itertools.pairwise(edges)]
        return chunks


@dataclass
class GroupBatch:
    """Groups of a shard that train at the same time, one per device; leaves ``[devices * group_size, ...]``."""

    agents: Agent
    keys: Any
    state: Any
    best: Best


@dataclass
class Training:
    """A shard between two chunks.

    Attributes:
        trainer: the programs.
        group_batches: the agents with their states.
        chunks_done: chunks that are finished.
        episode_slots, episodes: of every chunk, ``[B]``: total length and number of the training episodes that ended in it.
        scores: of every validation, ``[B]``: its score.
        seconds: wall time by activity.
        consistent: ``False`` while a chunk is under way: its buffers are donated, and nothing can be saved.
    """

    trainer: Trainer
    group_batches: list[GroupBatch]
    chunks_done: int = 0
    consistent: bool = True
    episode_slots: list[np.ndarray] = field(default_factory=list)
    episodes: list[np.ndarray] = field(default_factory=list)
    scores: list[np.ndarray] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=lambda: {"train": 0.0, "validate": 0.0})

    @property
    def finished(self) -> bool:
        """Whether no chunk is left."""
        return self.chunks_done == len(self.trainer.chunks)

    @property
    def validated(self) -> bool:
        """Whether the last chunk ended with a validation."""
        return self.chunks_done > 0 and self.trainer.chunks[self.chunks_done - 1].validates

    @property
    def steps(self) -> int:
        """Environment steps that each agent has made."""
        if not self.chunks_done:
            return 0
        return self.trainer.chunks[self.chunks_done - 1].last * self.trainer.algorithm.steps_per_iteration

    @property
    def mean_episode_length(self) -> float:
        """Mean length of the training episodes that ended in the last chunk, slots."""
        return float(self.episode_slots[-1].sum() / max(self.episodes[-1].sum(), 1))

    @property
    def best_scores(self) -> np.ndarray:
        """``[B]`` best validation score so far."""
        return concatenate(batch.best.score for batch in self.group_batches)

    def run(self, until: int | None = None) -> Iterator[None]:
        """Train chunk after chunk: the one host loop of all trainings. Yields after every chunk.

        Args:
            until: number of chunks after which to stop; by default all.
        """
        until = len(self.trainer.chunks) if until is None else until
        while self.chunks_done < until:
            self._advance()
            yield

    def _advance(self) -> None:
        """Train one more chunk, and validate if one ends with it."""
        chunk, programs = self.trainer.chunks[self.chunks_done], self.trainer.programs
        tick, self.consistent = time.perf_counter(), False
        for batch in self.group_batches:
            batch.state = programs.update(batch.agents, batch.state, np.int32(chunk.first), np.int32(chunk.last))
        self.episode_slots.append(concatenate(batch.state.episode_slots for batch in self.group_batches))
        self.episodes.append(concatenate(batch.state.episodes for batch in self.group_batches))
        self.seconds["train"] += time.perf_counter() - tick
        self.chunks_done += 1
        if chunk.validates:
            self._validate()
        self.consistent = True

    def _validate(self) -> None:
        tick, scores, step = time.perf_counter(), [], np.int32(self.steps)
        for batch in self.group_batches:
            score, batch.best = self.trainer.programs.validate(
                batch.agents, batch.keys, batch.state.weights, batch.best, step
            )
            scores.append(score)
        self.scores.append(concatenate(scores))
        self.seconds["validate"] += time.perf_counter() - tick

    def arrays(self) -> dict[str, np.ndarray]:
        """Return everything that changes during training by name, group by group; not copied where the device is the CPU."""
        curves = {"episode_slots": self.episode_slots, "episodes": self.episodes, "scores": self.scores}
        named = {f"curves/{name}": np.stack(values) for name, values in curves.items() if values}
        for number, batch in enumerate(self.group_batches):
            for path, leaf in jax.tree.leaves_with_path((batch.state, batch.best)):
                for place, piece in enumerate(sorted(leaf.addressable_shards, key=lambda one: one.index[0].start or 0)):
                    named[self._name(number, place, path)] = np.asarray(piece.data)
        return named

    def restore(self, chunks_done: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore the training as it was after ``chunks_done`` chunks, from what :meth:`arrays` returned then.

        Raises:
            ValueError: the arrays are those of another training.
        """
        validations = sum(chunk.validates for chunk in self.trainer.chunks[:chunks_done])
        for name, count in (("episode_slots", chunks_done), ("episodes", chunks_done), ("scores", validations)):
            curve = list(arrays[f"curves/{name}"]) if count else []
            if len(curve) != count:
                raise ValueError(f"curves/{name} has {len(curve)} entries; it should have {count}")
            setattr(self, name, curve)
        for number, batch in enumerate(self.group_batches):

            def leaf_of(path: Any, old: Any, number: int = number) -> Any:
                devices, shape = self.trainer.mesh.devices, old.sharding.shard_shape(old.shape)
                pieces = []
                for place, device in enumerate(devices):
                    name = self._name(number, place, path)
                    piece = arrays.get(name)
                    if piece is None or (piece.shape, piece.dtype) != (shape, old.dtype):
                        raise ValueError(f"{name} is missing, or not {old.dtype} {list(shape)}")
                    pieces.append(jax.device_put(piece, device, may_alias=False))
                made = jax.make_array_from_single_device_arrays(old.shape, old.sharding, pieces)
                old.delete()  # a replay is large: never hold all of it twice
                return made

            batch.state, batch.best = jax.tree.map_with_path(leaf_of, (batch.state, batch.best))
        self.chunks_done = chunks_done

    def _name(self, batch: int, place: int, path: Any) -> str:
        group = batch * self.trainer.mesh.size + place
        return f"{group}/{jax.tree_util.keystr(path, simple=True, separator='/')}"

    def weights(self, agents: int) -> dict[str, Any]:
        """Return the best and the last weights so far of the first ``agents`` agents, leaves ``[agents, ...]``."""
        return {
            "best": _gather([batch.best.weights for batch in self.group_batches], agents),
            "last": _gather([batch.state.weights for batch in self.group_batches], agents),
        }

    def result(self, agents: int) -> TrainedShard:
        """Return what the shard leaves: its first ``agents`` agents, the others are padding."""
        chunks, per_iteration = self.trainer.chunks, self.trainer.algorithm.steps_per_iteration
        slots, counts = np.stack(self.episode_slots, 1)[:agents], np.stack(self.episodes, 1)[:agents]
        return TrainedShard(
            **self.weights(agents),
            best_step=_gather([batch.best.step for batch in self.group_batches], agents),
            best_score=_gather([batch.best.score for batch in self.group_batches], agents),
            diverged_at=_gather([batch.state.diverged_at for batch in self.group_batches], agents),
            chunk_steps=np.array([chunk.last * per_iteration for chunk in chunks]),
            episode_length=np.where(counts > 0, slots / np.maximum(counts, 1), np.nan).astype(np.float32),
            validation_steps=np.array([chunk.last * per_iteration for chunk in chunks if chunk.validates]),
            validation=np.stack(self.scores, 1)[:agents],
            seconds=self.seconds,
        )


def concatenate(pieces: Any) -> np.ndarray:
    """Concatenate the group batches' parts into ``[B]``."""
    return np.concatenate([np.asarray(piece) for piece in pieces])


def _gather(trees: list[Any], agents: int) -> Any:
    """Leaves of the group batches as one, on the host, without padding."""
    return jax.tree.map(lambda *leaves: concatenate(leaves)[:agents], *trees)

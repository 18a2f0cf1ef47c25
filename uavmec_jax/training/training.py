"""The training of one block of agents in lockstep: a host loop over jitted, donated chunks.

Between any two chunks it can be kept and taken up again. A block consists of groups of one size, each trained by one
program on one device. All local devices share the groups; where there are fewer devices than groups, the
groups take turns within every chunk. So what comes out is the same to the bit on one device, two or four.
"""

import itertools
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Key

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.training.partition import Blocks
from uavmec_jax.training.programs import Best, Programs, make_mesh, no_best_yet, on_devices


@dataclass(frozen=True)
class Validation:
    """When and how the greedy policy is looked at during training.

    Attributes:
        every: environment steps of one agent between looks, rounded to whole iterations.
        draws: volume draws per look.
        chunks: jitted chunks per look, for the progress display and the training curve.
    """

    every: int = 10_000
    draws: int = 8
    chunks: int = 4


@dataclass(frozen=True)
class TrainedBlock:
    """What one block leaves; NumPy arrays, ``B`` the agents of the block (padding removed).

    Attributes:
        last: weights after the last step, leaves ``[B, ...]``.
        best: weights of the best look, leaves ``[B, ...]``.
        best_step: ``[B]`` environment step of the best look.
        best_score: ``[B]`` validation score of the best look: mean lifetime in slots, or, of agents that are paid for
            traffic, mean return.
        diverged_at: ``[B]`` step at which an agent was frozen, -1 if it was not.
        chunk_steps: ``[C]`` environment steps of one agent at the end of each chunk.
        episode_length: ``[B, C]`` mean length of the training episodes that ended in each chunk (NaN if none did).
        look_steps: ``[L]`` environment steps of one agent at each look.
        validation: ``[B, L]`` validation score at each look.
        seconds: wall time by activity: ``train``, ``validate``.
    """

    last: Any
    best: Any
    best_step: np.ndarray
    best_score: np.ndarray
    diverged_at: np.ndarray
    chunk_steps: np.ndarray
    episode_length: np.ndarray
    look_steps: np.ndarray
    validation: np.ndarray
    seconds: dict[str, float]


@dataclass(frozen=True)
class Trainer:
    """The compiled programs that train blocks of one shape, on the local devices.

    Attributes:
        algorithm: what trains.
        validation: the looks during training.
        blocks: how the population is cut.
        mesh: the devices that share a block's groups.
        programs: for as many groups as there are devices.
        compile_seconds: what compiling them took.
    """

    algorithm: Algorithm
    validation: Validation
    blocks: Blocks
    mesh: Mesh
    programs: Programs
    compile_seconds: float

    @classmethod
    def compile(
        cls, algorithm: Algorithm, agents: Agent, keys: Key[Array, "B D"], validation: Validation, blocks: Blocks
    ) -> "Trainer":
        """Compile for blocks like the one given: its agents, leaves ``[B, ...]``, and their validation draws."""
        started = time.perf_counter()
        mesh = make_mesh(blocks.devices)
        wave = blocks.size // blocks.groups * mesh.size
        programs = Programs.compile(algorithm, mesh, jax.tree.map(lambda leaf: leaf[:wave], (agents, keys)))
        return cls(algorithm, validation, blocks, mesh, programs, time.perf_counter() - started)

    def start(self, agents: Agent, keys: Key[Array, "B D"]) -> "Training":
        """A block before its first step."""
        size = self.blocks.size // self.blocks.groups * self.mesh.size
        waves = []
        for first in range(0, self.blocks.size, size):
            here = slice(first, first + size)
            members, draws = on_devices(self.mesh, jax.tree.map(lambda leaf, here=here: leaf[here], (agents, keys)))
            state = self.programs.init(members)
            waves.append(Wave(members, draws, state, no_best_yet(state)))
        return Training(self, waves)

    @cached_property
    def chunks(self) -> list[tuple[int, int, bool]]:
        """``(first, last, whether a look follows)`` of every chunk; the last one always ends with a look."""
        every = max(self.validation.every // self.algorithm.steps_per_iteration, 1)
        found = []
        for start in range(0, self.algorithm.iterations, every):
            stop = min(start + every, self.algorithm.iterations)
            edges = np.linspace(start, stop, min(self.validation.chunks, stop - start) + 1).astype(int)
            found += [(int(first), int(last), int(last) == stop) for first, last in itertools.pairwise(edges)]
        return found


@dataclass
class Wave:
    """As many groups of a block as there are devices: they train at the same time."""

    agents: Agent
    keys: Any
    state: Any
    best: Best


@dataclass
class Training:
    """A block between two chunks.

    Attributes:
        trainer: the programs.
        waves: the agents with their states.
        done: chunks that are through.
        slots, episodes: of every chunk, ``[B]``: total length and number of the training episodes that ended in it.
        scores: of every look, ``[B]``: validation score.
        seconds: wall time by activity.
        sound: ``False`` while a chunk is under way: the arrays are given away, and nothing can be kept.
    """

    trainer: Trainer
    waves: list[Wave]
    done: int = 0
    sound: bool = True
    slots: list[np.ndarray] = field(default_factory=list)
    episodes: list[np.ndarray] = field(default_factory=list)
    scores: list[np.ndarray] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=lambda: {"train": 0.0, "validate": 0.0})

    @property
    def finished(self) -> bool:
        """Whether there is no chunk left."""
        return self.done == len(self.trainer.chunks)

    @property
    def looked(self) -> bool:
        """Whether the last chunk ended with a look."""
        return self.done > 0 and self.trainer.chunks[self.done - 1][2]

    @property
    def steps(self) -> int:
        """Environment steps that each agent has made."""
        return self.trainer.chunks[self.done - 1][1] * self.trainer.algorithm.steps_per_iteration if self.done else 0

    @property
    def mean_length(self) -> float:
        """Mean length of the training episodes that ended in the last chunk, slots."""
        return float(self.slots[-1].sum() / max(self.episodes[-1].sum(), 1))

    @property
    def best_scores(self) -> np.ndarray:
        """``[B]`` score of the best look so far."""
        return joined(wave.best.score for wave in self.waves)

    def advance(self) -> None:
        """Train one more chunk, and look if it is time to."""
        first, last, is_look = self.trainer.chunks[self.done]
        programs = self.trainer.programs
        tick, self.sound = time.perf_counter(), False
        for wave in self.waves:
            wave.state = programs.update(wave.agents, wave.state, np.int32(first), np.int32(last))
        self.slots.append(joined(wave.state.episode_slots for wave in self.waves))
        self.episodes.append(joined(wave.state.episodes for wave in self.waves))
        self.seconds["train"] += time.perf_counter() - tick
        self.done += 1
        if is_look:
            tick = time.perf_counter()
            scores = []
            for wave in self.waves:
                score, wave.best = programs.look(
                    wave.agents, wave.keys, wave.state.weights, wave.best, np.int32(self.steps)
                )
                scores.append(score)
            self.scores.append(joined(scores))
            self.seconds["validate"] += time.perf_counter() - tick
        self.sound = True

    def arrays(self) -> dict[str, np.ndarray]:
        """All that changes while a block trains, by name, group by group; no copies where the device is the CPU."""
        curves = {"slots": self.slots, "episodes": self.episodes, "scores": self.scores}
        named = {f"curves/{name}": np.stack(values) for name, values in curves.items() if values}
        for number, wave in enumerate(self.waves):
            for path, leaf in jax.tree.leaves_with_path((wave.state, wave.best)):
                for place, shard in enumerate(sorted(leaf.addressable_shards, key=lambda one: one.index[0].start or 0)):
                    named[self._name(number, place, path)] = np.asarray(shard.data)
        return named

    def restore(self, done: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Go back to where a training was after ``done`` chunks, from what :meth:`arrays` told then.

        Raises:
            ValueError: the arrays are those of another training.
        """
        looks = sum(is_look for _, _, is_look in self.trainer.chunks[:done])
        for name, wanted in (("slots", done), ("episodes", done), ("scores", looks)):
            found = list(arrays[f"curves/{name}"]) if wanted else []
            if len(found) != wanted:
                raise ValueError(f"curves/{name} has {len(found)} entries, {wanted} are wanted")
            setattr(self, name, found)
        for number, wave in enumerate(self.waves):

            def leaf_of(path: Any, old: Any, number: int = number) -> Any:
                devices, shape = self.trainer.mesh.devices, old.sharding.shard_shape(old.shape)
                pieces = []
                for place, device in enumerate(devices):
                    name = self._name(number, place, path)
                    piece = arrays.get(name)
                    if piece is None or (piece.shape, piece.dtype) != (shape, old.dtype):
                        raise ValueError(f"{name} is not there, or not {old.dtype} {list(shape)}")
                    pieces.append(jax.device_put(piece, device, may_alias=False))
                made = jax.make_array_from_single_device_arrays(old.shape, old.sharding, pieces)
                old.delete()  # a replay is large: never hold all of it twice
                return made

            wave.state, wave.best = jax.tree.map_with_path(leaf_of, (wave.state, wave.best))
        self.done = done

    def _name(self, wave: int, place: int, path: Any) -> str:
        group = wave * self.trainer.mesh.size + place
        return f"{group}/{jax.tree_util.keystr(path, simple=True, separator='/')}"

    def weights(self, real: int) -> dict[str, Any]:
        """The best and the last weights so far of the first ``real`` agents, leaves ``[real, ...]``."""
        return {
            "best": _kept([wave.best.weights for wave in self.waves], real),
            "last": _kept([wave.state.weights for wave in self.waves], real),
        }

    def trained(self, real: int) -> TrainedBlock:
        """What the block leaves: its first ``real`` agents, the others are padding."""
        chunks, per_iteration = self.trainer.chunks, self.trainer.algorithm.steps_per_iteration
        slots, counts = np.stack(self.slots, 1)[:real], np.stack(self.episodes, 1)[:real]
        return TrainedBlock(
            **self.weights(real),
            best_step=_kept([wave.best.step for wave in self.waves], real),
            best_score=_kept([wave.best.score for wave in self.waves], real),
            diverged_at=_kept([wave.state.diverged_at for wave in self.waves], real),
            chunk_steps=np.array([last * per_iteration for _, last, _ in chunks]),
            episode_length=np.where(counts > 0, slots / np.maximum(counts, 1), np.nan).astype(np.float32),
            look_steps=np.array([last * per_iteration for _, last, is_look in chunks if is_look]),
            validation=np.stack(self.scores, 1)[:real],
            seconds=self.seconds,
        )


def joined(pieces: Any) -> np.ndarray:
    """``[B]`` from the waves' parts."""
    return np.concatenate([np.asarray(piece) for piece in pieces])


def _kept(trees: list[Any], real: int) -> Any:
    """Leaves of the waves as one, on the host, without padding."""
    return jax.tree.map(lambda *leaves: joined(leaves)[:real], *trees)

"""Many agents in lockstep: the agent axis, the devices, and a host loop over jitted, donated chunks.

The population is cut into equal blocks that train one after the other. Within a block the agent axis is split over the
local devices, and every device runs the same program without talking to the others.
"""

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Key

from uavmec_jax.learning.algorithm import AGENTS_AXIS, Agent, Algorithm
from uavmec_jax.learning.blocks import Blocks
from uavmec_jax.world.rollout import returns, rollouts


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
class Progress:
    """One line of news from the host loop, after every chunk."""

    block: int
    steps: int
    """Environment steps made by the whole population."""
    of_steps: int
    mean_length: float
    """Mean length of the training episodes that ended in the chunk, slots."""


@dataclass(frozen=True)
class TrainedBlock:
    """What one block leaves; NumPy arrays, ``B`` the agents of the block (padding removed).

    Attributes:
        agents: slice of the population that it holds.
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
        seconds: wall time by activity: ``compile``, ``train``, ``validate``.
    """

    agents: slice
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


@struct.dataclass
class Best:
    """The best weights so far: ``weights`` leaves ``[B, ...]``, their validation ``score`` and ``step`` ``[B]``."""

    weights: Any
    score: Any
    step: Any


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
        blocks: from :func:`uavmec_jax.learning.blocks.plan_blocks`.
        on_progress: told after every chunk.
    """
    n_agents = validation_keys.shape[0]
    mesh = Mesh(np.array(jax.local_devices()[: blocks.devices]), (AGENTS_AXIS,))
    started = time.perf_counter()
    programs = Programs.compile(algorithm, mesh, _take(agents, validation_keys, 0, blocks.size))
    compile_seconds = time.perf_counter() - started
    for block in range(blocks.count):
        first = block * blocks.size
        real = min(blocks.size, n_agents - first)
        members = on_devices(mesh, agents, validation_keys, first, blocks.size)

        def report(steps: int, mean_length: float, block: int = block, first: int = first, real: int = real) -> None:
            done = first * algorithm.total_steps + real * steps
            on_progress(Progress(block, done, n_agents * algorithm.total_steps, mean_length))

        trained = _train_block(algorithm, programs, members, validation, slice(first, first + real), report)
        trained.seconds["compile"] = compile_seconds if block == 0 else 0.0
        yield trained


def _take(agents: Agent, keys: Key[Array, "A D"], first: int, size: int) -> tuple[Agent, Key[Array, "B D"]]:
    """``size`` agents from ``first`` on; past the end the last one is repeated, to keep the shape."""
    places = np.minimum(np.arange(first, first + size), keys.shape[0] - 1)
    taken: tuple[Agent, Key[Array, "B D"]] = jax.tree.map(lambda leaf: leaf[places], (agents, keys))
    return taken


def on_devices(
    mesh: Mesh, agents: Agent, keys: Key[Array, "A D"], first: int, size: int
) -> tuple[Agent, Key[Array, "B D"]]:
    """``size`` agents from ``first`` on and their draws, split over the devices of a mesh."""
    placed: tuple[Agent, Key[Array, "B D"]] = jax.device_put(
        _take(agents, keys, first, size), NamedSharding(mesh, PartitionSpec(AGENTS_AXIS))
    )
    return placed


@dataclass(frozen=True)
class Programs:
    """The compiled programs of one block shape, the agent axis split over the devices of a mesh.

    ``init(agents) -> state``; ``update(agents, state, first, last) -> state``, the old state is given away;
    ``look(agents, keys, weights, best, step) -> (score [B], best)``, the old best is given away.
    """

    init: Callable
    update: Callable
    look: Callable

    @classmethod
    def compile(cls, algorithm: Algorithm, mesh: Mesh, example: tuple[Agent, Key[Array, "B D"]]) -> "Programs":
        """Compile for blocks like ``example``: the agents and their validation draws."""
        split, shared = PartitionSpec(AGENTS_AXIS), PartitionSpec()

        def over_agents(function: Callable, n_split: int, n_shared: int = 0, **jit: Any) -> Any:
            batched = jax.vmap(function, (0,) * n_split + (None,) * n_shared, axis_name=AGENTS_AXIS)
            specs = (split,) * n_split + (shared,) * n_shared
            # check_vma: the branch in `update` is decided per device, which the checker has no type for.
            mapped = jax.shard_map(batched, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)
            return jax.jit(mapped, **jit)

        sharding = NamedSharding(mesh, split)
        struct_of = lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)  # noqa: E731
        agents, keys = jax.tree.map(struct_of, example)
        init = over_agents(algorithm.init, 1)
        state = jax.tree.map(struct_of, jax.eval_shape(init, agents))
        batch = sharding.shard_shape((keys.shape[0],))[0] * mesh.size
        number = jax.ShapeDtypeStruct((batch,), np.float32, sharding=sharding)
        best = Best(
            weights=state.weights, score=number, step=jax.ShapeDtypeStruct((batch,), np.int32, sharding=sharding)
        )
        options = _compiler_options()
        update = over_agents(algorithm.update, 2, 2, donate_argnums=1, compiler_options=options)
        look = over_agents(partial(_look, algorithm), 4, 1, donate_argnums=3)
        return cls(
            init=init.lower(agents).compile(),
            update=update.lower(agents, state, 0, 1).compile(),
            look=look.lower(agents, keys, state.weights, best, 0).compile(),
        )


def _compiler_options() -> dict[str, bool]:
    """One core per device: XLA's schedule for concurrent execution only costs memory traffic (7 % of the speed)."""
    return {"xla_cpu_enable_concurrency_optimized_scheduler": False} if jax.default_backend() == "cpu" else {}


def _look(algorithm: Algorithm, agent: Agent, keys: Key[Array, " D"], weights: Any, best: Best, step: Any) -> Any:
    """Validation score of the greedy policy of one agent, and the best so far (ties keep the earlier).

    The score is the mean lifetime; of agents that are paid for more, for traffic, it is what they earn.
    """
    scenario = agent.scenario
    policy = algorithm.policy(agent.hyper, weights)
    score = jnp.mean(rollouts(policy, scenario.params, scenario.layout, keys).length.astype(jnp.float32))
    if scenario.layout.traffic is not None:
        paid = (scenario.reward.traffic_bonus > 0) | (scenario.reward.traffic_penalty > 0)
        score = jnp.where(paid, jnp.mean(returns(policy, scenario, keys)), score)
    better = score > best.score
    kept = jax.tree.map(
        lambda new, old: jnp.where(better, new, old), (weights, score, step), (best.weights, best.score, best.step)
    )
    return score, Best(*kept)


def _train_block(
    algorithm: Algorithm,
    programs: Programs,
    members: tuple[Agent, Key[Array, "B D"]],
    validation: Validation,
    agents: slice,
    report: Callable[[int, float], None],
) -> TrainedBlock:
    """Train one block to the end: chunks, looks, curves."""
    agent, keys = members
    state = programs.init(agent)
    size = keys.shape[0]
    shard = state.diverged_at.sharding
    best = Best(
        weights=jax.tree.map(jnp.copy, state.weights),
        score=jax.device_put(jnp.full((size,), -jnp.inf), shard),
        step=jax.device_put(jnp.zeros((size,), jnp.int32), shard),
    )
    seconds = {"train": 0.0, "validate": 0.0}
    slots, episodes, chunk_ends, scores, look_ends = [], [], [], [], []
    for first, last, is_look in _chunks(algorithm, validation):
        tick = time.perf_counter()
        state = programs.update(agent, state, np.int32(first), np.int32(last))
        slots.append(np.asarray(state.episode_slots))
        episodes.append(np.asarray(state.episodes))
        seconds["train"] += time.perf_counter() - tick
        steps = last * algorithm.steps_per_iteration
        chunk_ends.append(steps)
        if is_look:
            tick = time.perf_counter()
            score, best = programs.look(agent, keys, state.weights, best, np.int32(steps))
            scores.append(np.asarray(score))
            look_ends.append(steps)
            seconds["validate"] += time.perf_counter() - tick
        report(steps, float(slots[-1].sum() / max(episodes[-1].sum(), 1)))

    real = agents.stop - agents.start
    keep: Callable[[Any], Any] = lambda tree: jax.tree.map(lambda leaf: np.asarray(leaf)[:real], tree)  # noqa: E731
    counts = np.stack(episodes, 1)[:real]
    return TrainedBlock(
        agents=agents,
        last=keep(state.weights),
        best=keep(best.weights),
        best_step=keep(best.step),
        best_score=keep(best.score),
        diverged_at=keep(state.diverged_at),
        chunk_steps=np.array(chunk_ends),
        episode_length=np.where(counts > 0, np.stack(slots, 1)[:real] / np.maximum(counts, 1), np.nan).astype(
            np.float32
        ),
        look_steps=np.array(look_ends),
        validation=np.stack(scores, 1)[:real],
        seconds=seconds,
    )


def _chunks(algorithm: Algorithm, validation: Validation) -> Iterator[tuple[int, int, bool]]:
    """``(first, last, whether a look follows)`` for every chunk; the last chunk always ends with a look."""
    every = max(validation.every // algorithm.steps_per_iteration, 1)
    for start in range(0, algorithm.iterations, every):
        stop = min(start + every, algorithm.iterations)
        edges = np.linspace(start, stop, min(validation.chunks, stop - start) + 1).astype(int)
        for first, last in itertools.pairwise(edges):
            yield int(first), int(last), last == stop

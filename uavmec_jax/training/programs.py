"""The compiled programs of a population: the agent axis is split over the devices of a mesh, which do not communicate."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Key

from uavmec_jax.agents.algorithm import AGENTS_AXIS, Agent, Algorithm
from uavmec_jax.env.generator import ScenarioDistribution
from uavmec_jax.env.rollout import Policy, priced_lifetimes, returns, rollouts
from uavmec_jax.env.scenario import Scenario


@struct.dataclass
class Best:
    """The best weights so far: ``weights`` leaves ``[B, ...]``, their validation ``score`` and ``step`` ``[B]``."""

    weights: Any
    score: Any
    step: Any


def make_mesh(devices: int) -> Mesh:
    """The first local devices as a mesh of one axis, the agents."""
    return Mesh(np.array(jax.local_devices()[:devices]), (AGENTS_AXIS,))


def put_on_mesh(mesh: Mesh, tree: Any) -> Any:
    """Leaves ``[B, ...]`` split over the devices of a mesh."""
    return jax.device_put(tree, NamedSharding(mesh, PartitionSpec(AGENTS_AXIS)))


@dataclass(frozen=True)
class Programs:
    """The compiled programs of one shape, the agent axis split over the devices of a mesh.

    ``init(agents) -> state``; ``update(agents, state, first, last) -> state``, whose state is donated;
    ``validate(agents, keys, weights, best, step) -> (score [B], best)``, whose best is donated.
    """

    init: Callable
    update: Callable
    validate: Callable

    @classmethod
    def compile(cls, algorithm: Algorithm, mesh: Mesh, example: tuple[Agent, Key[Array, "B D"]]) -> "Programs":
        """Compile for agents and validation draws like ``example``."""
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
        validate = over_agents(partial(_validate, algorithm), 4, 1, donate_argnums=3)
        return cls(
            init=init.lower(agents).compile(),
            update=update.lower(agents, state, 0, 1).compile(),
            validate=validate.lower(agents, keys, state.weights, best, 0).compile(),
        )


def _compiler_options() -> dict[str, bool]:
    """One core per device: XLA's schedule for concurrent execution only costs memory traffic (7 % of the speed)."""
    return {"xla_cpu_enable_concurrency_optimized_scheduler": False} if jax.default_backend() == "cpu" else {}


def initial_best(state: Any) -> Best:
    """Before the first validate: the weights of a state, which any validate betters."""
    size, sharding = state.diverged_at.shape[0], state.diverged_at.sharding
    return Best(
        weights=jax.tree.map(jnp.copy, state.weights),
        score=jax.device_put(jnp.full((size,), -jnp.inf), sharding),
        step=jax.device_put(jnp.zeros((size,), jnp.int32), sharding),
    )


def _validate(algorithm: Algorithm, agent: Agent, keys: Key[Array, " D"], weights: Any, best: Best, step: Any) -> Any:
    """Validation score of the greedy policy of one agent, and the best so far (ties keep the earlier).

    The draws are of task volumes; of agents that play many scenarios, of a scenario each besides.
    """
    score = _score(algorithm.policy(agent.hyper, weights), agent.scenario, keys)
    better = score > best.score
    kept = jax.tree.map(
        lambda new, old: jnp.where(better, new, old), (weights, score, step), (best.weights, best.score, best.step)
    )
    return score, Best(*kept)


def _score(policy: Policy, plays: Scenario | ScenarioDistribution, keys: Key[Array, " D"]) -> Array:
    """The mean lifetime; of agents that are paid for more, for traffic, what they earn.

    Where every draw is another scenario, lives are counted less the price of the first failure.
    """
    if isinstance(plays, ScenarioDistribution):
        return jnp.mean(priced_lifetimes(policy, plays, keys))
    score = jnp.mean(rollouts(policy, plays.params, plays.layout, keys).length.astype(jnp.float32))
    if plays.layout.traffic is not None:
        paid = (plays.reward.traffic_bonus > 0) | (plays.reward.traffic_penalty > 0)
        score = jnp.where(paid, jnp.mean(returns(policy, plays, keys)), score)
    return score

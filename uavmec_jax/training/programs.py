"""The compiled programs of a population. The agent axis is sharded over the devices of a mesh, which do not communicate."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int, Key

from uavmec_jax.agents.algorithm import AGENTS_AXIS, Agent, Algorithm, AlgorithmState
from uavmec_jax.agents.networks import Weights
from uavmec_jax.env.drawn_rollouts import priced_lifetimes
from uavmec_jax.env.generator import ScenarioDistribution
from uavmec_jax.env.rollout import Policy, returns, rollouts
from uavmec_jax.env.scenario import Scenario


@struct.dataclass
class Best:
    """The weights with the best validation score so far.

    Attributes:
        weights: parameters of the network.
        score: their validation score.
        step: environment step of that validation, int32.
    """

    weights: Weights
    score: Float[Array, "*batch"]
    step: Int[Array, "*batch"]


def make_mesh(devices: int) -> Mesh:
    """Return a mesh of the first local devices; its one axis is that of the agents."""
    return Mesh(np.array(jax.local_devices()[:devices]), (AGENTS_AXIS,))


def put_on_mesh(mesh: Mesh, tree: Any) -> Any:
    """Shard leaves ``[B, ...]`` over the devices of a mesh."""
    return jax.device_put(tree, NamedSharding(mesh, PartitionSpec(AGENTS_AXIS)))


@dataclass(frozen=True)
class Programs:
    """The compiled programs for a batch of ``B`` agents, sharded over the devices of a mesh.

    Attributes:
        init: ``(agents) -> state``.
        update: ``(agents, state, first, last) -> state``: runs the iterations ``first <= i < last``; donates ``state``.
        validate: ``(agents, keys, weights, best, step) -> (score [B], best)``; donates ``best``.
    """

    init: Callable
    update: Callable
    validate: Callable

    @classmethod
    def compile(cls, algorithm: Algorithm, mesh: Mesh, example: tuple[Agent, Key[Array, "B D"]]) -> "Programs":
        """Compile the programs for the shapes of an example: agents and the keys of their validations."""
        split, shared = PartitionSpec(AGENTS_AXIS), PartitionSpec()
        sharding = NamedSharding(mesh, split)

        def over_agents(function: Callable, n_split: int, n_shared: int = 0, **jit: Any) -> Any:
            batched = jax.vmap(function, (0,) * n_split + (None,) * n_shared, axis_name=AGENTS_AXIS)
            specs = (split,) * n_split + (shared,) * n_shared
            # check_vma: the branch in `update` is decided on each device, which the checker cannot express.
            mapped = jax.shard_map(batched, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)
            # out_shardings: XLA would replicate empty leaves, such as the packs of no depots.
            return jax.jit(mapped, out_shardings=sharding, **jit)

        struct_of = lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)  # noqa: E731
        agents, keys = jax.tree.map(struct_of, example)
        init = over_agents(algorithm.init, 1)
        state = jax.tree.map(struct_of, jax.eval_shape(init, agents))
        batch = sharding.shard_shape((keys.shape[0],))[0] * mesh.size
        vector: Any = partial(jax.ShapeDtypeStruct, (batch,), sharding=sharding)
        best = Best(weights=state.policy_weights, score=vector(np.float32), step=vector(np.int32))
        update = over_agents(algorithm.update, 2, 2, donate_argnums=1, compiler_options=_compiler_options())
        validate = over_agents(partial(_validate, algorithm), 4, 1, donate_argnums=3)
        return cls(
            init=init.lower(agents).compile(),
            update=update.lower(agents, state, 0, 1).compile(),
            validate=validate.lower(agents, keys, state.policy_weights, best, 0).compile(),
        )


def _compiler_options() -> dict[str, bool]:
    """Return options for one core per device, where XLA's schedule for concurrent execution costs 7 % of the speed."""
    return {"xla_cpu_enable_concurrency_optimized_scheduler": False} if jax.default_backend() == "cpu" else {}


def initial_best(state: AlgorithmState) -> Best:
    """Return the best weights before the first validation: those of ``state``, with a score that every other exceeds."""
    size, sharding = state.diverged_at.shape[0], state.diverged_at.sharding
    return Best(
        weights=jax.tree.map(jnp.copy, state.policy_weights),
        score=jax.device_put(jnp.full((size,), -jnp.inf), sharding),
        step=jax.device_put(jnp.zeros((size,), jnp.int32), sharding),
    )


def _validate(
    algorithm: Algorithm, agent: Agent, keys: Key[Array, " D"], weights: Weights, best: Best, step: Int[Array, ""]
) -> tuple[Float[Array, ""], Best]:
    """Return the validation score of one agent's greedy policy, and the best weights so far; ties keep the earlier ones.

    Each key draws the task volumes of one episode and, from a distribution, its scenario.
    """
    score = _score(algorithm.policy(agent.hyper, weights), agent.scenario, keys)
    is_better = score > best.score
    candidate = Best(weights=weights, score=score, step=step)
    return score, jax.tree.map(lambda new, old: jnp.where(is_better, new, old), candidate, best)


def _score(policy: Policy, scenario: Scenario | ScenarioDistribution, keys: Key[Array, " D"]) -> Float[Array, ""]:
    """Return the mean lifetime in slots, or the mean return if the reward also counts traffic.

    In scenarios drawn from a distribution, the price of the first failure is subtracted from each lifetime.
    """
    if isinstance(scenario, ScenarioDistribution):
        return jnp.mean(priced_lifetimes(policy, scenario, keys))
    score = jnp.mean(rollouts(policy, scenario.params, scenario.layout, keys).length.astype(jnp.float32))
    if scenario.layout.traffic is not None:
        counts_traffic = (scenario.reward.traffic_bonus > 0) | (scenario.reward.traffic_penalty > 0)
        score = jnp.where(counts_traffic, jnp.mean(returns(policy, scenario, keys)), score)
    return score

"""What PPO and A2C share: an actor, a value_fn and their weights.

One iteration plays ``n_steps`` slots in each of ``n_envs`` environments of an agent (:mod:`uavmec_jax.agents.collect_rollout`)
and then learns from them; how, is all that the two differ in (:mod:`uavmec_jax.agents.ppo`,
:mod:`uavmec_jax.agents.a2c`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.agents.networks import count_weights, scale_ages
from uavmec_jax.agents.observation_spec import OBSERVATIONS, ObservationSpec
from uavmec_jax.agents.optimizers import TrainState
from uavmec_jax.env.dynamics import State, initial_state
from uavmec_jax.env.generator import ScenarioDistribution, sample_scenario
from uavmec_jax.env.scenario import Scenario

_WEIGHTS_STREAM, _SCENARIOS_STREAM = 2**32 - 1, 2**32 - 2
"""``fold_in`` numbers of the initial weights and scenarios; the iterations use their own numbers, from 0."""


@struct.dataclass
class OnPolicyHyper:
    """Hyperparameters that may differ between agents of one program (traced)."""

    learning_rate: Any = struct.field(default=3e-4, metadata={"gt": 0})
    gamma: Any = struct.field(default=0.98, metadata={"ge": 0, "le": 1})
    gae_lambda: Any = struct.field(default=0.95, metadata={"ge": 0, "le": 1})
    ent_coef: Any = struct.field(default=0.0, metadata={"ge": 0})
    vf_coef: Any = struct.field(default=0.5, metadata={"ge": 0})
    max_grad_norm: Any = struct.field(default=0.5, metadata={"gt": 0})
    normalize_advantage: Any = True
    """Whether generalized_advantages are normalised within each minibatch."""
    age_scale: Any = struct.field(default=1.0, metadata={"gt": 0})
    """Factor on the ages as the networks observation_fn them in the paper's observation; 1 in the paper."""


@dataclass(frozen=True)
class OnPolicySpec:
    """What shapes the program (static)."""

    total_steps: int = 1_000_000
    """Environment steps of one agent; rounded up to whole iterations."""
    hidden: tuple[int, ...] = field(default=(64, 64), metadata={"items": {"ge": 1, "le": 4096}})
    observation: str = field(default="paper", metadata={"choices": tuple(OBSERVATIONS)})
    """What the networks observation_fn: ``paper``, batteries and ages, or ``full``, for which they are permutation-equivariant."""
    n_envs: int = field(default=1, metadata={"ge": 1, "le": 4096})
    """Environments of one agent."""
    n_steps: int = field(default=2048, metadata={"ge": 1, "le": 1_000_000})
    """Slots played in each environment between updates."""
    n_devices: int = 12

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one agent in one iteration."""
        return self.n_steps * self.n_envs

    @property
    def iterations(self) -> int:
        """Iterations of a whole training."""
        return -(-self.total_steps // self.steps_per_iteration)

    @property
    def observation_spec(self) -> ObservationSpec:
        """What the networks observation_fn."""
        return OBSERVATIONS[self.observation]

    @property
    def obs_size(self) -> int:
        """Numbers in one observation."""
        return self.observation_spec.obs_size(self.n_devices)

    @property
    def network(self) -> Any:
        """Policy and value networks."""
        return self.observation_spec.network(self.n_devices, self.hidden)

    @property
    def agent_bytes(self) -> int:
        """Memory of one agent in training, bytes: a rollout and its shuffled copy, weights, opt_state, gradient, best."""
        rollout = self.steps_per_iteration * (2 * (self.obs_size + 4) + self.n_devices + 1)
        return 4 * (rollout + 6 * count_weights(self.network, self.obs_size))


@struct.dataclass
class OnPolicyState:
    """Everything that changes while one agent trains.

    Attributes:
        weights: of the two networks.
        opt_state: the optimiser's.
        env_states: states of the environments, leaves ``[n_envs, ...]``.
        scenarios: what each environment plays, leaves ``[n_envs, ...]``; ``None`` where it is the agent's scenario.
        diverged_at: int32, environment step at which the agent was frozen, -1 while it is sound.
        episode_slots: int32, total length of the episodes that ended in this call of ``update``.
        episodes: int32, how many those were.
        loss: f32, last loss.
    """

    weights: Any
    opt_state: Any
    env_states: State
    diverged_at: Any
    episode_slots: Any
    episodes: Any
    loss: Any
    scenarios: Scenario | None = None

    @property
    def train_state(self) -> TrainState:
        """What a gradient step moves."""
        return TrainState(self.weights, self.opt_state, self.diverged_at)

    def after(self, train_state: TrainState, loss: Float[Array, ""]) -> "OnPolicyState":
        """The state after gradient steps."""
        return replace(
            self,
            weights=train_state.weights,
            opt_state=train_state.opt_state,
            diverged_at=train_state.diverged_at,
            loss=loss,
        )


def bind(
    name: str,
    spec: OnPolicySpec,
    optimizer: optax.GradientTransformationExtraArgs,
    iteration: Callable[[Agent, OnPolicyState, Any], OnPolicyState],
) -> Algorithm:
    """An algorithm from what it learns by: ``iteration(agent, state, i)`` plays and learns once."""
    return Algorithm(
        name=name,
        iterations=spec.iterations,
        steps_per_iteration=spec.steps_per_iteration,
        agent_bytes=spec.agent_bytes,
        init=partial(init, spec, optimizer),
        update=partial(_update, iteration),
        greedy=partial(greedy, spec),
        observation_fn=spec.observation_spec.observation_fn,
        value_fn=partial(value, spec),
    )


def init(spec: OnPolicySpec, optimizer: optax.GradientTransformationExtraArgs, agent: Agent) -> OnPolicyState:
    """A fresh agent: orthogonal weights, a new episode in every environment."""
    weights = spec.network.init(jax.random.fold_in(agent.key, _WEIGHTS_STREAM), jnp.zeros((1, spec.obs_size)))
    scenarios = None
    if isinstance(agent.scenario, ScenarioDistribution):
        keys = jax.random.split(jax.random.fold_in(agent.key, _SCENARIOS_STREAM), spec.n_envs)
        scenarios = jax.vmap(partial(sample_scenario, agent.scenario))(keys)
        env_states = jax.vmap(initial_state)(scenarios.params, scenarios.layout)
    else:
        env_state = initial_state(agent.scenario.params, agent.scenario.layout)
        env_states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (spec.n_envs, *jnp.shape(leaf))), env_state)
    return OnPolicyState(
        weights=weights,
        opt_state=optimizer.init(weights),
        env_states=env_states,
        diverged_at=jnp.int32(-1),
        episode_slots=jnp.int32(0),
        episodes=jnp.int32(0),
        loss=jnp.float32(0),
        scenarios=scenarios,
    )


def _update(
    iteration: Callable[[Agent, OnPolicyState, Any], OnPolicyState],
    agent: Agent,
    state: OnPolicyState,
    first: Any,
    last: Any,
) -> OnPolicyState:
    """Advance one agent by the iterations ``first <= i < last`` (shared scalars, traced); run under ``vmap``."""
    state = replace(state, episode_slots=jnp.int32(0), episodes=jnp.int32(0))
    return jax.lax.fori_loop(first, last, lambda i, carry: iteration(agent, carry, i), state)


def greedy(
    spec: OnPolicySpec, hyper: OnPolicyHyper, weights: Any, observation: Float[Array, "*b two_n"]
) -> Int[Array, "*b"]:
    """The likeliest action; ties go to the lowest number."""
    scores = logits(spec, hyper, weights, observation.reshape(-1, observation.shape[-1]))
    return jnp.argmax(scores, axis=-1).astype(jnp.int32).reshape(observation.shape[:-1])


def _seen(
    spec: OnPolicySpec, hyper: OnPolicyHyper, observation: Float[Array, "b obs_size"]
) -> Float[Array, "b obs_size"]:
    """Observations as the networks take them: the paper's with its ages scaled."""
    return scale_ages(observation, hyper.age_scale) if spec.observation == "paper" else observation


def logits(spec: OnPolicySpec, hyper: OnPolicyHyper, weights: Any, observation: Float[Array, "b obs_size"]) -> Array:
    """Unnormalised log-probabilities ``[B, n]``."""
    scores: Any = spec.network.apply(weights, _seen(spec, hyper, observation), method="logits")
    return scores


def value(spec: OnPolicySpec, hyper: OnPolicyHyper, weights: Any, observation: Float[Array, "b obs_size"]) -> Array:
    """State values ``[B]``."""
    worth: Any = spec.network.apply(weights, _seen(spec, hyper, observation), method="value")
    return worth


def both(
    spec: OnPolicySpec, hyper: OnPolicyHyper, weights: Any, observation: Float[Array, "b obs_size"]
) -> tuple[Array, Array]:
    """:func:`logits` and :func:`value` in one pass through what the two networks share."""
    found: Any = spec.network.apply(weights, _seen(spec, hyper, observation))
    return found

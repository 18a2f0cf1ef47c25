"""What PPO and A2C share: settings, networks and state of an agent that learns a policy and state values.

One iteration plays ``n_steps`` slots in each of an agent's ``n_envs`` environments
(:mod:`uavmec_jax.agents.collect_rollout`) and then learns from these samples. The two algorithms differ in how they learn
(:mod:`uavmec_jax.agents.ppo`, :mod:`uavmec_jax.agents.a2c`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import struct
from jaxtyping import Array, Float, Int

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.agents.environments import Environments, start
from uavmec_jax.agents.networks import Weights, count_weights, scale_ages
from uavmec_jax.agents.observation_spec import OBSERVATIONS, ObservationSpec
from uavmec_jax.agents.optimizers import TrainState
from uavmec_jax.env.dynamics import State
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.env.types import Scalar

_WEIGHTS_STREAM = 2**32 - 1
"""``fold_in`` number of the initial weights; the iterations use their own numbers, from 0."""


@struct.dataclass
class ActorCriticHyper:
    """Hyperparameters that may differ between agents of one program (traced)."""

    learning_rate: Scalar = struct.field(default=3e-4, metadata={"gt": 0})
    gamma: Scalar = struct.field(default=0.98, metadata={"ge": 0, "le": 1})
    gae_lambda: Scalar = struct.field(default=0.95, metadata={"ge": 0, "le": 1})
    ent_coef: Scalar = struct.field(default=0.0, metadata={"ge": 0})
    vf_coef: Scalar = struct.field(default=0.5, metadata={"ge": 0})
    max_grad_norm: Scalar = struct.field(default=0.5, metadata={"gt": 0})
    normalize_advantage: Scalar = True
    """Whether advantages are normalised within each minibatch."""
    age_scale: Scalar = struct.field(default=1.0, metadata={"gt": 0})
    """Factor on the ages in the paper's observation; 1 in the paper."""


@dataclass(frozen=True)
class ActorCriticSpec:
    """Static settings, which shape the program."""

    total_steps: int = 1_000_000
    """Environment steps of one agent; rounded up to whole iterations."""
    hidden: tuple[int, ...] = field(default=(64, 64), metadata={"items": {"ge": 1, "le": 4096}, "max_length": 32})
    observation: str = field(default="paper", metadata={"choices": tuple(OBSERVATIONS)})
    """Input of the networks: ``paper`` (batteries and ages), or ``full``, with which they are permutation-equivariant."""
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
        """The observation, and the networks that take it."""
        return OBSERVATIONS[self.observation]

    @property
    def obs_size(self) -> int:
        """Length of an observation."""
        return self.observation_spec.obs_size(self.n_devices)

    @property
    def network(self) -> nn.Module:
        """Policy and value networks."""
        return self.observation_spec.network(self.n_devices, self.hidden)

    @property
    def agent_bytes(self) -> int:
        """Memory of one agent in training, bytes.

        That is a rollout and its shuffled copy, the weights, the optimiser's moments, a gradient and the best weights.
        """
        rollout = self.steps_per_iteration * (2 * (self.obs_size + 4) + self.n_devices + 1)
        return 4 * (rollout + 6 * count_weights(self.network, self.obs_size))


@struct.dataclass
class ActorCriticState:
    """Everything that changes while an agent trains.

    Attributes:
        weights: parameters of the two networks.
        opt_state: the optimiser's state.
        env_states: states of the environments, leaves ``[n_envs, ...]``.
        diverged_at: environment step at which the agent was frozen, int32; -1 if it has not diverged.
        episode_slots: total length of the episodes that ended in this call of ``update``, slots, int32.
        episodes: number of these episodes, int32.
        loss: the last loss.
        scenarios: the scenario of each environment, leaves ``[n_envs, ...]``; ``None`` if all have the agent's.
    """

    weights: Weights
    opt_state: optax.OptState
    env_states: State
    diverged_at: Int[Array, "*batch"]
    episode_slots: Int[Array, "*batch"]
    episodes: Int[Array, "*batch"]
    loss: Float[Array, "*batch"]
    scenarios: Scenario | None = None

    @property
    def policy_weights(self) -> Weights:
        """What the greedy policy is made from."""
        return self.weights

    @property
    def environments(self) -> Environments:
        """The environments, and their scenarios."""
        return Environments(self.env_states, self.scenarios)

    @property
    def train_state(self) -> TrainState:
        """The part that gradient steps change."""
        return TrainState(self.weights, self.opt_state, self.diverged_at)

    def with_train_state(self, train_state: TrainState, loss: Float[Array, ""]) -> "ActorCriticState":
        """Return the state after gradient steps."""
        return replace(
            self,
            weights=train_state.weights,
            opt_state=train_state.opt_state,
            diverged_at=train_state.diverged_at,
            loss=loss,
        )


Iteration = Callable[[Agent, ActorCriticState, Int[Array, ""]], ActorCriticState]
"""``iteration(agent, state, i) -> state``: plays a rollout and learns from it; ``i`` is the iteration's number."""


def make_algorithm(
    name: str, spec: ActorCriticSpec, optimizer: optax.GradientTransformationExtraArgs, iteration: Iteration
) -> Algorithm:
    """Return the algorithm that runs ``iteration``."""
    return Algorithm(
        name=name,
        iterations=spec.iterations,
        steps_per_iteration=spec.steps_per_iteration,
        agent_bytes=spec.agent_bytes,
        init=partial(init, spec, optimizer),
        update=partial(_update, iteration),
        greedy=partial(greedy_action, spec),
        observation_fn=spec.observation_spec.observation_fn,
        value_fn=partial(value, spec),
    )


def init(spec: ActorCriticSpec, optimizer: optax.GradientTransformationExtraArgs, agent: Agent) -> ActorCriticState:
    """Return an agent's state before training: orthogonal weights, and a new episode in every environment."""
    weights = spec.network.init(jax.random.fold_in(agent.key, _WEIGHTS_STREAM), jnp.zeros((1, spec.obs_size)))
    environments = start(agent, spec.n_envs)
    return ActorCriticState(
        weights=weights,
        opt_state=optimizer.init(weights),
        env_states=environments.states,
        diverged_at=jnp.int32(-1),
        episode_slots=jnp.int32(0),
        episodes=jnp.int32(0),
        loss=jnp.float32(0),
        scenarios=environments.scenarios,
    )


def _update(
    iteration: Iteration, agent: Agent, state: ActorCriticState, first: Int[Array, ""], last: Int[Array, ""]
) -> ActorCriticState:
    """Run the iterations ``first <= i < last`` of one agent; the bounds are shared by all agents. Call it under ``vmap``."""
    state = replace(state, episode_slots=jnp.int32(0), episodes=jnp.int32(0))
    return jax.lax.fori_loop(first, last, lambda i, carry: iteration(agent, carry, i), state)


def greedy_action(
    spec: ActorCriticSpec, hyper: ActorCriticHyper, weights: Weights, observation: Float[Array, "*b obs_size"]
) -> Int[Array, "*b"]:
    """Return the action with the highest probability; ties go to the lowest number."""
    rows = observation.reshape(-1, observation.shape[-1])
    action = jnp.argmax(logits(spec, hyper, weights, rows), axis=-1).astype(jnp.int32)
    return action.reshape(observation.shape[:-1])


def _network_input(
    spec: ActorCriticSpec, hyper: ActorCriticHyper, observation: Float[Array, "b obs_size"]
) -> Float[Array, "b obs_size"]:
    """Return observations as the networks take them: the paper's with scaled ages, the full ones unchanged."""
    return scale_ages(observation, hyper.age_scale) if spec.observation == "paper" else observation


def logits(
    spec: ActorCriticSpec, hyper: ActorCriticHyper, weights: Weights, observation: Float[Array, "b obs_size"]
) -> Float[Array, "b n"]:
    """Return the unnormalised log-probabilities of the actions."""
    output: Any = spec.network.apply(weights, _network_input(spec, hyper, observation), method="logits")
    return output


def value(
    spec: ActorCriticSpec, hyper: ActorCriticHyper, weights: Weights, observation: Float[Array, "b obs_size"]
) -> Float[Array, " b"]:
    """Return the state values."""
    output: Any = spec.network.apply(weights, _network_input(spec, hyper, observation), method="value")
    return output


def logits_and_value(
    spec: ActorCriticSpec, hyper: ActorCriticHyper, weights: Weights, observation: Float[Array, "b obs_size"]
) -> tuple[Float[Array, "b n"], Float[Array, " b"]]:
    """Return :func:`logits` and :func:`value` from one pass through the layers that the two networks share."""
    output: Any = spec.network.apply(weights, _network_input(spec, hyper, observation))
    return output

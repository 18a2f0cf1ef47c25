"""What PPO and A2C share: an actor and a critic, rollouts of a few environments, generalised advantages.

One iteration plays ``n_steps`` slots in each of ``n_envs`` environments of an agent and then learns from them; how, is all
that the two differ in (:mod:`uavmec_jax.learning.ppo`, :mod:`uavmec_jax.learning.a2c`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from uavmec_jax.learning.algorithm import AGENTS_AXIS, Agent, Algorithm
from uavmec_jax.learning.networks import ActorCritic, n_weights, scale_ages
from uavmec_jax.learning.optimizers import Descent
from uavmec_jax.world.environment import advance, draw_volumes, is_truncated, observe, restart_if
from uavmec_jax.world.physics import Cause, State, initial_state

_WEIGHTS_STREAM = 2**32 - 1
"""``fold_in`` number of the initial weights; the iterations use their own numbers, from 0."""


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
    """Whether advantages are normalised within each minibatch."""
    age_scale: Any = struct.field(default=1.0, metadata={"gt": 0})
    """Factor on the ages as the networks see them; 1 in the paper."""


@dataclass(frozen=True)
class OnPolicySpec:
    """What shapes the program (static)."""

    total_steps: int = 1_000_000
    """Environment steps of one agent; rounded up to whole iterations."""
    hidden: tuple[int, ...] = (64, 64)
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
    def network(self) -> ActorCritic:
        """Policy and value networks."""
        return ActorCritic(n_actions=self.n_devices, hidden=self.hidden)

    @property
    def agent_bytes(self) -> int:
        """Memory of one agent in training, bytes: a rollout and its shuffled copy, weights, moments, gradient, best."""
        rollout = self.steps_per_iteration * (2 * (2 * self.n_devices + 4) + self.n_devices + 1)
        return 4 * (rollout + 6 * n_weights(self.network, 2 * self.n_devices))


@struct.dataclass
class OnPolicyState:
    """Everything that changes while one agent trains.

    Attributes:
        weights: of the two networks.
        moments: the optimiser's.
        worlds: states of the environments, leaves ``[n_envs, ...]``.
        diverged_at: int32, environment step at which the agent was frozen, -1 while it is sound.
        episode_slots: int32, total length of the episodes that ended in this call of ``update``.
        episodes: int32, how many those were.
        loss: f32, last loss.
    """

    weights: Any
    moments: Any
    worlds: State
    diverged_at: Any
    episode_slots: Any
    episodes: Any
    loss: Any

    @property
    def descent(self) -> Descent:
        """What a gradient step moves."""
        return Descent(self.weights, self.moments, self.diverged_at)

    def after(self, descent: Descent, loss: Float[Array, ""]) -> "OnPolicyState":
        """The state after gradient steps."""
        return replace(
            self, weights=descent.weights, moments=descent.moments, diverged_at=descent.diverged_at, loss=loss
        )


class Samples(NamedTuple):
    """What a gradient is taken on, leading axis ``B``.

    ``observation`` f32 ``[B, 2n]``, ``action`` int32 ``[B]``, ``advantage``, ``returns`` f32 ``[B]``, and ``log_prob``
    f32 ``[B]``, the log-probability of the action when it was taken.
    """

    observation: Array
    action: Array
    advantage: Array
    returns: Array
    log_prob: Array


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
    )


def init(spec: OnPolicySpec, optimizer: optax.GradientTransformationExtraArgs, agent: Agent) -> OnPolicyState:
    """A fresh agent: orthogonal weights, a new episode in every environment."""
    observation = jnp.zeros((1, 2 * spec.n_devices))
    weights = spec.network.init(jax.random.fold_in(agent.key, _WEIGHTS_STREAM), observation)
    world = initial_state(agent.scenario.params, agent.scenario.layout)
    return OnPolicyState(
        weights=weights,
        moments=optimizer.init(weights),
        worlds=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (spec.n_envs, *jnp.shape(leaf))), world),
        diverged_at=jnp.int32(-1),
        episode_slots=jnp.int32(0),
        episodes=jnp.int32(0),
        loss=jnp.float32(0),
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


def logits(spec: OnPolicySpec, hyper: OnPolicyHyper, weights: Any, observation: Float[Array, "b two_n"]) -> Array:
    """Unnormalised log-probabilities ``[B, n]``; the ages are scaled as the agent's hyperparameters say."""
    scores: Any = spec.network.apply(weights, scale_ages(observation, hyper.age_scale), method="logits")
    return scores


def value(spec: OnPolicySpec, hyper: OnPolicyHyper, weights: Any, observation: Float[Array, "b two_n"]) -> Array:
    """State values ``[B]``."""
    worth: Any = spec.network.apply(weights, scale_ages(observation, hyper.age_scale), method="value")
    return worth


def choose(scores: Float[Array, "e n"], uniform: Float[Array, " e"]) -> Int[Array, " e"]:
    """Actions ``[E]`` drawn from the softmax of ``scores``, each by one uniform number in [0, 1)."""
    mass = jnp.cumsum(jnp.exp(scores - jnp.max(scores, axis=-1, keepdims=True)), axis=-1)
    below = jnp.sum(mass <= uniform[:, None] * mass[:, -1:], axis=-1)
    return jnp.minimum(below, scores.shape[-1] - 1).astype(jnp.int32)


def play(spec: OnPolicySpec, agent: Agent, state: OnPolicyState, key: PRNGKeyArray) -> tuple[OnPolicyState, Samples]:
    """Play ``n_steps`` slots in every environment; returns ``n_steps * n_envs`` samples, environments innermost.

    All randomness is one draw: per slot and environment a volume for each device, and one number for the action.
    """
    n, hyper, weights = spec.n_devices, agent.hyper, state.weights
    bits = jax.random.bits(key, (spec.n_steps, spec.n_envs, n + 1))

    def slot(state: OnPolicyState, bits: Any) -> tuple[OnPolicyState, tuple]:
        uniform = (bits >> 8).astype(jnp.float32) * 2.0**-24
        return _slot(spec, agent, state, uniform)

    state, (observation, action, reward, ended) = jax.lax.scan(slot, state, bits)
    flat = observation.reshape(-1, 2 * n)
    values = value(spec, hyper, weights, flat).reshape(reward.shape)
    ahead = value(spec, hyper, weights, jax.vmap(observe, (None, 0))(agent.scenario.layout, state.worlds))
    advantage = advantages(reward, values, ahead, ended, hyper.gamma, hyper.gae_lambda)
    taken = action.reshape(-1)
    return state, Samples(
        observation=flat,
        action=taken,
        advantage=advantage.reshape(-1),
        returns=(advantage + values).reshape(-1),
        log_prob=log_probability(logits(spec, hyper, weights, flat), taken)[0],
    )


def _slot(
    spec: OnPolicySpec, agent: Agent, state: OnPolicyState, uniform: Float[Array, "e n_plus_1"]
) -> tuple[OnPolicyState, tuple[Array, Array, Array, Array]]:
    """One slot in every environment: observations before it, actions, rewards, whether an episode ended.

    Where the time limit alone ended an episode, the reward holds the discounted value of what was cut off.
    """
    scenario, layout, n = agent.scenario, agent.scenario.layout, spec.n_devices
    over_envs = lambda function, *arguments: jax.vmap(function)(*arguments)  # noqa: E731
    observation = over_envs(lambda world: observe(layout, world), state.worlds)
    action = choose(logits(spec, agent.hyper, state.weights, observation), uniform[:, n])
    volumes = draw_volumes(scenario.params, uniform[:, :n])
    after, reward, outcome = over_envs(lambda *slot: advance(scenario, *slot), state.worlds, action, volumes)
    truncated = over_envs(lambda *slot: is_truncated(scenario, *slot), after, outcome)
    ended = (outcome.cause != Cause.NONE) | truncated

    def with_cut_off() -> Array:
        final = over_envs(lambda world: observe(layout, world), after)
        worth = agent.hyper.gamma * value(spec, agent.hyper, state.weights, final)
        return reward + jnp.where(truncated, worth, 0.0)

    cut = jax.lax.pmax(jnp.any(truncated), AGENTS_AXIS)  # a true branch: the predicate is the same for all agents
    reward = jax.lax.cond(cut, with_cut_off, lambda: reward)
    state = replace(
        state,
        worlds=over_envs(lambda end, world: restart_if(end, scenario, world), ended, after),
        episode_slots=state.episode_slots + jnp.sum(jnp.where(ended, after.slot, 0)),
        episodes=state.episodes + jnp.sum(ended),
    )
    return state, (observation, action, reward, ended)


def advantages(
    reward: Float[Array, "t e"],
    value: Float[Array, "t e"],
    last_value: Float[Array, " e"],
    ended: Bool[Array, "t e"],
    gamma: Any,
    gae_lambda: Any,
) -> Float[Array, "t e"]:
    """Generalised advantage estimates (Schulman et al., 2016, equation 16).

    Args:
        reward: of each slot.
        value: of the state before each slot.
        last_value: of the states after the last slot.
        ended: whether an episode ended with the slot.
        gamma: discount.
        gae_lambda: lambda.
    """

    def back(later: tuple[Array, Array], slot: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], Array]:
        (advantage, next_value), (reward, value, ended) = later, slot
        goes_on = 1.0 - ended
        delta = reward + gamma * next_value * goes_on - value
        advantage = delta + gamma * gae_lambda * goes_on * advantage
        return (advantage, value), advantage

    return jax.lax.scan(back, (jnp.zeros_like(last_value), last_value), (reward, value, ended), reverse=True)[1]


def log_probability(scores: Float[Array, "b n"], action: Int[Array, " b"]) -> tuple[Array, Array]:
    """Log-probability ``[B]`` of each action, and the entropy ``[B]`` of each distribution."""
    logs = jax.nn.log_softmax(scores, axis=-1)
    taken = jnp.sum(logs * jax.nn.one_hot(action, scores.shape[-1]), axis=-1)
    return taken, -jnp.sum(jnp.exp(logs) * logs, axis=-1)


def normalized(advantage: Float[Array, " b"], normalize: Any) -> Float[Array, " b"]:
    """Advantages of mean zero and deviation one (ddof 1, plus 1e-8) where ``normalize``; a single one stays as it is."""
    if advantage.shape[0] < 2:
        return advantage
    scaled = (advantage - jnp.mean(advantage)) / (jnp.std(advantage, ddof=1) + 1e-8)
    return jnp.where(normalize, scaled, advantage)

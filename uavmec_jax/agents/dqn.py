"""Deep Q-learning as the paper ran it (Stable-Baselines3's DQN with Table 4), and its usual variants: one agent.

``init`` makes an agent's state, ``update`` advances it by a stretch of iterations; one iteration is ``train_frequency``
environment steps and one gradient step. The population (:mod:`uavmec_jax.training.population`) adds the agent axis with
``vmap``: the iteration number is shared by all agents and never batched, everything of one agent is.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int, UInt

from uavmec_jax.agents import replay
from uavmec_jax.agents.algorithm import AGENTS_AXIS, Agent, Algorithm
from uavmec_jax.agents.networks import QNetwork, count_weights, scale_ages
from uavmec_jax.agents.optimizers import TrainState, apply_gradients, clipped_adam
from uavmec_jax.env.dynamics import Cause, State, initial_state
from uavmec_jax.env.observation import observe
from uavmec_jax.env.scenario import advance, auto_reset, draw_volumes, is_truncated

_WEIGHTS_STREAM = 2**32 - 1
"""``fold_in`` number of the initial weights; the iterations use their own numbers, from 0."""


@struct.dataclass
class DQNHyper:
    """Hyperparameters that may differ between agents of one program (traced). Defaults: Table 4 and the library's."""

    learning_rate: Any = struct.field(default=0.0071, metadata={"gt": 0})
    gamma: Any = struct.field(default=0.98, metadata={"ge": 0, "le": 1})
    exploration_initial_eps: Any = struct.field(default=1.0, metadata={"ge": 0, "le": 1})
    exploration_final_eps: Any = struct.field(default=0.05, metadata={"ge": 0, "le": 1})
    exploration_fraction: Any = struct.field(default=0.35, metadata={"gt": 0, "le": 1})
    """Share of all steps over which epsilon falls linearly."""
    target_interval: Any = struct.field(default=10_000, metadata={"ge": 1})
    """Environment steps of one agent between updates of the target network."""
    tau: Any = struct.field(default=1.0, metadata={"gt": 0, "le": 1})
    """Share of the online network in an update of the target: 1 copies it, less is a soft update."""
    learning_starts: Any = struct.field(default=100, metadata={"ge": 0})
    """Environment steps of one agent with random actions and without gradient steps."""
    max_grad_norm: Any = struct.field(default=10.0, metadata={"gt": 0})
    age_scale: Any = struct.field(default=1.0, metadata={"gt": 0})
    """Factor on the ages as the network sees them; 1 in the paper."""


@dataclass(frozen=True)
class DQNSpec:
    """What shapes the program (static)."""

    total_steps: int = 1_000_000
    """Environment steps of one agent; rounded up to whole iterations."""
    hidden: tuple[int, ...] = field(default=(64, 64), metadata={"items": {"ge": 1, "le": 4096}})
    batch_size: int = field(default=16, metadata={"ge": 1})
    train_frequency: int = field(default=4, metadata={"ge": 1, "le": 64})
    """Environment steps per gradient step."""
    replay_capacity: int = field(default=1_000_000, metadata={"ge": 1})
    double: bool = False
    """The online network chooses the next action, the target network judges it (van Hasselt et al., 2016)."""
    dueling: bool = False
    """State value and generalized_advantages instead of Q-values (Wang et al., 2016)."""
    n_step: int = field(default=1, metadata={"ge": 1, "le": 64})
    """Rewards summed before the bootstrap (Sutton, 1988)."""
    n_devices: int = 12
    max_age: int = 11

    @property
    def iterations(self) -> int:
        """Iterations of a whole training."""
        return -(-self.total_steps // self.train_frequency)

    @property
    def obs_size(self) -> int:
        """Numbers in one observation."""
        return 2 * self.n_devices

    @property
    def network(self) -> QNetwork:
        """The Q-network."""
        return QNetwork(n_actions=self.n_devices, hidden=self.hidden, dueling=self.dueling)

    @property
    def replay(self) -> replay.ReplaySpec:
        """The memory. One that is never overrun needs no more room than there are steps."""
        steps = self.iterations * self.train_frequency
        return replay.ReplaySpec(
            n_devices=self.n_devices,
            capacity=min(self.replay_capacity, steps),
            stride=self.train_frequency,
            max_age=self.max_age,
            wraps=self.replay_capacity < steps,
            n_step=self.n_step,
        )

    @property
    def agent_bytes(self) -> int:
        """Memory of one agent in training, bytes: replay, weights, target, opt_state, gradient, best weights."""
        return self.replay.bytes + 6 * 4 * count_weights(self.network, self.obs_size)


@struct.dataclass
class DQNState:
    """Everything that changes while one agent trains.

    Attributes:
        weights: of the Q-network.
        target: of the target network.
        opt_state: Adam's, ``optax.ScaleByAdamState``.
        env_state: state of the environment.
        rows: replay memory, ``[rows, obs_size]`` uint32.
        diverged_at: int32, environment step at which the agent was frozen, -1 while it is sound.
        episode_slots: int32, total length of the episodes that ended in this call of ``update``.
        episodes: int32, how many those were.
        loss: f32, last loss.
    """

    weights: Any
    target: Any
    opt_state: Any
    env_state: State
    rows: Any
    diverged_at: Any
    episode_slots: Any
    episodes: Any
    loss: Any


def algorithm(spec: DQNSpec) -> Algorithm:
    """Bind the static settings."""
    return Algorithm(
        name="dqn",
        iterations=spec.iterations,
        steps_per_iteration=spec.train_frequency,
        agent_bytes=spec.agent_bytes,
        init=partial(init, spec),
        update=partial(update, spec),
        greedy=partial(greedy, spec),
    )


def init(spec: DQNSpec, agent: Agent) -> DQNState:
    """A fresh agent: random weights, target equal to them, empty memory, a new episode."""
    observation = jnp.zeros((1, 2 * spec.n_devices))
    weights = spec.network.init(jax.random.fold_in(agent.key, _WEIGHTS_STREAM), observation)
    return DQNState(
        weights=weights,
        target=jax.tree.map(jnp.copy, weights),
        opt_state=clipped_adam().init(weights),
        env_state=initial_state(agent.scenario.params, agent.scenario.layout),
        rows=replay.init(spec.replay),
        diverged_at=jnp.int32(-1),
        episode_slots=jnp.int32(0),
        episodes=jnp.int32(0),
        loss=jnp.float32(0),
    )


def update(spec: DQNSpec, agent: Agent, state: DQNState, first: Any, last: Any) -> DQNState:
    """Advance one agent by the iterations ``first <= i < last`` (shared scalars, traced); run under ``vmap``."""
    state = replace(state, episode_slots=jnp.int32(0), episodes=jnp.int32(0))
    return jax.lax.fori_loop(first, last, lambda i, carry: _iteration(spec, agent, carry, i), state)


def epsilon(hyper: DQNHyper, total_steps: int, steps_done: Any) -> Float[Array, ""]:
    """Exploration rate when ``steps_done`` environment steps have been made: linear, then constant."""
    progress = jnp.asarray(steps_done, jnp.float32) / total_steps
    done = jnp.minimum(progress / hyper.exploration_fraction, 1.0)
    return hyper.exploration_initial_eps + done * (hyper.exploration_final_eps - hyper.exploration_initial_eps)


def gradient_steps(spec: DQNSpec, hyper: DQNHyper, steps_done: Any) -> Int[ArrayLike, ""]:
    """Gradient steps made once the iteration that ends at ``steps_done`` is through; 0 during the warm-up.

    The first falls at the first whole iteration that ends after ``learning_starts`` steps (step 104 in the paper).
    """
    return jnp.maximum(steps_done // spec.train_frequency - hyper.learning_starts // spec.train_frequency, 0)


def target_is_due(spec: DQNSpec, hyper: DQNHyper, steps_done: Any) -> Bool[ArrayLike, ""]:
    """Whether a multiple of the target interval lies in the iteration that ends at ``steps_done``."""
    return steps_done // hyper.target_interval > (steps_done - spec.train_frequency) // hyper.target_interval


def update_target(due: Bool[ArrayLike, ""], tau: Any, weights: Any, target: Any) -> Any:
    """The target network after an update, if one is due; with ``tau`` 1 it is the weights to the bit."""
    return jax.tree.map(lambda new, old: jnp.where(due, tau * new + (1.0 - tau) * old, old), weights, target)


def q_values(spec: DQNSpec, hyper: DQNHyper, weights: Any, observation: Float[Array, "*b two_n"]) -> Array:
    """Q-values ``[..., n]``; the ages are scaled as the agent's hyperparameters say."""
    values: Any = spec.network.apply(weights, scale_ages(observation, hyper.age_scale))
    return values


def greedy(spec: DQNSpec, hyper: DQNHyper, weights: Any, observation: Float[Array, "*b two_n"]) -> Int[Array, "*b"]:
    """The action of the highest Q-value; ties go to the lowest number."""
    return jnp.argmax(q_values(spec, hyper, weights, observation), axis=-1).astype(jnp.int32)


def td_loss(spec: DQNSpec, hyper: DQNHyper, weights: Any, target: Any, batch: replay.Transition) -> Float[Array, ""]:
    """Smooth-L1 loss of a minibatch ``[B]`` against the bootstrapped target (paper, equations 2 and 3)."""
    next_values = q_values(spec, hyper, target, batch.next_observation)
    best_next = jnp.max(next_values, axis=-1)
    if spec.double:
        chosen_next = jnp.argmax(q_values(spec, hyper, weights, batch.next_observation), axis=-1)
        best_next = jnp.sum(next_values * jax.nn.one_hot(chosen_next, spec.n_devices), axis=-1)
    td_target = batch.reward + (1.0 - batch.terminated) * batch.discount * best_next
    chosen = jax.nn.one_hot(batch.action, spec.n_devices)
    value = jnp.sum(q_values(spec, hyper, weights, batch.observation) * chosen, axis=-1)
    return jnp.mean(optax.huber_loss(value, td_target))


def _iteration(spec: DQNSpec, agent: Agent, state: DQNState, i: Int[Array, ""]) -> DQNState:
    """``train_frequency`` environment steps, the target copy if it is due, one gradient step.

    All randomness of the iteration is one draw: per environment step a volume for each device, whether to explore and
    where to; then one word for each sample.
    """
    steps_done = i * spec.train_frequency
    per_step = spec.n_devices + 2
    n_acting = spec.train_frequency * per_step
    bits = jax.random.bits(jax.random.fold_in(agent.key, i), (n_acting + spec.batch_size,))
    uniform = (bits[:n_acting] >> 8).astype(jnp.float32).reshape(spec.train_frequency, per_step) * 2.0**-24
    new_rows = []
    for j in range(spec.train_frequency):
        state, row = _act(spec, agent, state, steps_done + j, uniform[j])
        new_rows.append(row)
    rows = replay.add(spec.replay, state.rows, steps_done, jnp.stack(new_rows))
    steps_done += spec.train_frequency

    due = target_is_due(spec, agent.hyper, steps_done)
    target = jax.lax.cond(  # a true branch: the predicate is the same for all agents
        jax.lax.pmax(due, AGENTS_AXIS),
        lambda: update_target(due, agent.hyper.tau, state.weights, state.target),
        lambda: state.target,
    )
    batch = replay.sample(spec.replay, rows, steps_done, bits[n_acting:], agent.hyper.gamma)
    return _learn(spec, agent.hyper, replace(state, rows=rows, target=target), batch, steps_done)


def _act(
    spec: DQNSpec, agent: Agent, state: DQNState, steps_done: Any, uniform: Float[Array, " n_plus_2"]
) -> tuple[DQNState, UInt[Array, " obs_size"]]:
    """One epsilon-greedy environment step and the row to remember it by."""
    n = spec.n_devices
    scenario, layout = agent.scenario, agent.scenario.layout
    best = greedy(spec, agent.hyper, state.weights, observe(scenario.params, layout, state.env_state))
    anywhere = jnp.minimum((uniform[n + 1] * n).astype(jnp.int32), n - 1)
    warm_up = steps_done < agent.hyper.learning_starts
    explore = warm_up | (uniform[n] < epsilon(agent.hyper, spec.total_steps, steps_done))
    action = jnp.where(explore, anywhere, best)

    after, reward, outcome = advance(scenario, state.env_state, action, draw_volumes(scenario.params, uniform[:n]))
    terminated = outcome.cause != Cause.NONE
    ended = terminated | is_truncated(scenario, after, outcome)
    row = replay.pack(spec.replay, action, reward, after.battery / layout.capacity, after.age, terminated, ended)
    state = replace(
        state,
        env_state=auto_reset(ended, scenario, after),
        episode_slots=state.episode_slots + jnp.where(ended, after.slot, 0),
        episodes=state.episodes + ended,
    )
    return state, row


def _learn(spec: DQNSpec, hyper: DQNHyper, state: DQNState, batch: replay.Transition, steps_done: Any) -> DQNState:
    """One gradient step, unless the agent is still warming up or has diverged."""
    loss, gradient = jax.value_and_grad(lambda w: td_loss(spec, hyper, w, state.target, batch))(state.weights)
    after = apply_gradients(
        clipped_adam(),
        TrainState(state.weights, state.opt_state, state.diverged_at),
        loss,
        gradient,
        learning_rate=hyper.learning_rate,
        max_norm=hyper.max_grad_norm,
        count=gradient_steps(spec, hyper, steps_done),
        steps_done=steps_done,
        learning=steps_done > hyper.learning_starts,
    )
    return replace(state, weights=after.weights, opt_state=after.opt_state, diverged_at=after.diverged_at, loss=loss)

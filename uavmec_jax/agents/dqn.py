"""Deep Q-learning for one agent: as the paper ran it (Stable-Baselines3's DQN with Table 4), and its usual variants.

``init`` returns an agent's state before training, ``update`` runs some iterations; one iteration is ``train_frequency``
environment steps and one gradient step. The population (:mod:`uavmec_jax.training.population`) adds the agent axis with
``vmap``: the iteration number is shared by all agents and never batched; everything that belongs to one agent is batched.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int, UInt

from uavmec_jax.agents import replay
from uavmec_jax.agents.algorithm import AGENTS_AXIS, Agent, Algorithm
from uavmec_jax.agents.networks import QNetwork, Weights, count_weights, scale_ages
from uavmec_jax.agents.optimizers import TrainState, apply_gradients, clipped_adam
from uavmec_jax.env.dynamics import Cause, State, initial_state
from uavmec_jax.env.observation import observe
from uavmec_jax.env.scenario import Scenario, advance, auto_reset, draw_volumes, is_truncated
from uavmec_jax.env.types import Scalar

_WEIGHTS_STREAM = 2**32 - 1
"""``fold_in`` number of the initial weights; the iterations use their own numbers, from 0."""


@struct.dataclass
class DQNHyper:
    """Hyperparameters that may differ between agents of one program (traced).

    The defaults are those of Table 4, and Stable-Baselines3's where the paper gives none.
    """

    learning_rate: Scalar = struct.field(default=0.0071, metadata={"gt": 0})
    gamma: Scalar = struct.field(default=0.98, metadata={"ge": 0, "le": 1})
    exploration_initial_eps: Scalar = struct.field(default=1.0, metadata={"ge": 0, "le": 1})
    exploration_final_eps: Scalar = struct.field(default=0.05, metadata={"ge": 0, "le": 1})
    exploration_fraction: Scalar = struct.field(default=0.35, metadata={"gt": 0, "le": 1})
    """Share of all steps over which epsilon falls linearly."""
    target_interval: Scalar = struct.field(default=10_000, metadata={"ge": 1})
    """Environment steps of one agent between updates of the target network."""
    tau: Scalar = struct.field(default=1.0, metadata={"gt": 0, "le": 1})
    """Weight of the online network in an update of the target network: 1 copies it, less is a soft update."""
    learning_starts: Scalar = struct.field(default=100, metadata={"ge": 0})
    """Environment steps of one agent with random actions and without gradient steps."""
    max_grad_norm: Scalar = struct.field(default=10.0, metadata={"gt": 0})
    age_scale: Scalar = struct.field(default=1.0, metadata={"gt": 0})
    """Factor on the ages in the network's input; 1 in the paper."""


@dataclass(frozen=True)
class DQNSpec:
    """Static settings, which shape the program."""

    total_steps: int = 1_000_000
    """Environment steps of one agent; rounded up to whole iterations."""
    hidden: tuple[int, ...] = field(default=(64, 64), metadata={"items": {"ge": 1, "le": 4096}})
    batch_size: int = field(default=16, metadata={"ge": 1})
    train_frequency: int = field(default=4, metadata={"ge": 1, "le": 64})
    """Environment steps per gradient step."""
    replay_capacity: int = field(default=1_000_000, metadata={"ge": 1})
    double: bool = False
    """Whether the online network selects the next action and the target network evaluates it (van Hasselt et al., 2016)."""
    dueling: bool = False
    """Whether the network outputs a state value and advantages instead of Q-values (Wang et al., 2016)."""
    n_step: int = field(default=1, metadata={"ge": 1, "le": 64})
    """Number of rewards summed before the bootstrap (Sutton, 1988)."""
    n_devices: int = 12
    max_age: int = 11

    @property
    def iterations(self) -> int:
        """Iterations of a whole training."""
        return -(-self.total_steps // self.train_frequency)

    @property
    def obs_size(self) -> int:
        """Length of an observation."""
        return 2 * self.n_devices

    @property
    def network(self) -> QNetwork:
        """The Q-network."""
        return QNetwork(n_actions=self.n_devices, hidden=self.hidden, dueling=self.dueling)

    @property
    def replay(self) -> replay.ReplaySpec:
        """The replay buffer; its capacity is cut to the number of steps, which changes nothing."""
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
        """Memory of one agent in training, bytes.

        That is the replay buffer, the weights, the target's weights, two optimiser moments, a gradient and the best weights.
        """
        return self.replay.bytes + 6 * 4 * count_weights(self.network, self.obs_size)


@struct.dataclass
class DQNState:
    """Everything that changes while an agent trains.

    Attributes:
        weights: parameters of the Q-network.
        target: parameters of the target network.
        opt_state: Adam's moments.
        env_state: state of the environment.
        buffer_state: the replay buffer, see :mod:`uavmec_jax.agents.replay`.
        diverged_at: environment step at which the agent was frozen, int32; -1 if it has not diverged.
        episode_slots: total length of the episodes that ended in this call of ``update``, slots, int32.
        episodes: number of these episodes, int32.
        loss: the last loss.
    """

    weights: Weights
    target: Weights
    opt_state: optax.ScaleByAdamState
    env_state: State
    buffer_state: UInt[Array, "*batch rows words"]
    diverged_at: Int[Array, "*batch"]
    episode_slots: Int[Array, "*batch"]
    episodes: Int[Array, "*batch"]
    loss: Float[Array, "*batch"]

    @property
    def policy_weights(self) -> Weights:
        """What the greedy policy is made from."""
        return self.weights


def algorithm(spec: DQNSpec) -> Algorithm:
    """Return the algorithm with its static settings bound.

    Raises:
        ValueError: there are more devices than the replay buffer can tell apart.
    """
    if spec.n_devices > replay.MAX_ACTIONS:
        raise ValueError(
            f"n_devices is {spec.n_devices}; a DQN replay holds at most {replay.MAX_ACTIONS} devices; take ppo or a2c"
        )
    return Algorithm(
        name="dqn",
        iterations=spec.iterations,
        steps_per_iteration=spec.train_frequency,
        agent_bytes=spec.agent_bytes,
        init=partial(init, spec),
        update=partial(update, spec),
        greedy=partial(greedy_action, spec),
    )


def init(spec: DQNSpec, agent: Agent) -> DQNState:
    """Return an agent's state before training: random weights, a target equal to them, an empty buffer, a new episode."""
    scenario = _scenario(agent)
    weights = spec.network.init(jax.random.fold_in(agent.key, _WEIGHTS_STREAM), jnp.zeros((1, spec.obs_size)))
    return DQNState(
        weights=weights,
        target=jax.tree.map(jnp.copy, weights),
        opt_state=clipped_adam().init(weights),
        env_state=initial_state(scenario.params, scenario.layout),
        buffer_state=replay.init(spec.replay),
        diverged_at=jnp.int32(-1),
        episode_slots=jnp.int32(0),
        episodes=jnp.int32(0),
        loss=jnp.float32(0),
    )


def _scenario(agent: Agent) -> Scenario:
    """Return the scenario of all the agent's episodes; DQN does not train on distributions."""
    assert isinstance(agent.scenario, Scenario)
    return agent.scenario


def update(spec: DQNSpec, agent: Agent, state: DQNState, first: Int[Array, ""], last: Int[Array, ""]) -> DQNState:
    """Run the iterations ``first <= i < last`` of one agent; the bounds are shared by all agents. Call it under ``vmap``."""
    state = replace(state, episode_slots=jnp.int32(0), episodes=jnp.int32(0))
    return jax.lax.fori_loop(first, last, lambda i, carry: _iteration(spec, agent, carry, i), state)


def epsilon(hyper: DQNHyper, total_steps: int, steps_done: Int[ArrayLike, ""]) -> Float[Array, ""]:
    """Return the exploration rate after ``steps_done`` environment steps: it falls linearly, then stays constant."""
    progress = jnp.asarray(steps_done, jnp.float32) / total_steps
    done = jnp.minimum(progress / hyper.exploration_fraction, 1.0)
    return hyper.exploration_initial_eps + done * (hyper.exploration_final_eps - hyper.exploration_initial_eps)


def gradient_steps(spec: DQNSpec, hyper: DQNHyper, steps_done: int | Int[Array, ""]) -> Int[Array, ""]:
    """Return the number of gradient steps made by the end of the iteration that ends at ``steps_done``.

    The first one is made in the first whole iteration that ends after ``learning_starts`` steps (at step 104 in the paper).
    """
    return jnp.maximum(steps_done // spec.train_frequency - hyper.learning_starts // spec.train_frequency, 0)


def target_is_due(spec: DQNSpec, hyper: DQNHyper, steps_done: int | Int[Array, ""]) -> Bool[ArrayLike, ""]:
    """Return whether a multiple of the target interval lies in the iteration that ends at ``steps_done``."""
    return steps_done // hyper.target_interval > (steps_done - spec.train_frequency) // hyper.target_interval


def update_target(due: Bool[ArrayLike, ""], tau: Scalar, weights: Weights, target: Weights) -> Weights:
    """Update the target network if ``due``; with ``tau`` 1 it becomes a copy of the weights, to the bit."""
    return jax.tree.map(lambda new, old: jnp.where(due, tau * new + (1.0 - tau) * old, old), weights, target)


def q_values(
    spec: DQNSpec, hyper: DQNHyper, weights: Weights, observation: Float[Array, "*b obs_size"]
) -> Float[Array, "*b n"]:
    """Return the Q-values of all actions; the ages are multiplied by the agent's ``age_scale``."""
    values: Any = spec.network.apply(weights, scale_ages(observation, hyper.age_scale))
    return values


def greedy_action(
    spec: DQNSpec, hyper: DQNHyper, weights: Weights, observation: Float[Array, "*b obs_size"]
) -> Int[Array, "*b"]:
    """Return the action with the highest Q-value; ties go to the lowest number."""
    return jnp.argmax(q_values(spec, hyper, weights, observation), axis=-1).astype(jnp.int32)


def td_loss(
    spec: DQNSpec, hyper: DQNHyper, weights: Weights, target: Weights, batch: replay.Transition
) -> Float[Array, ""]:
    """Return the Huber loss of a minibatch against its bootstrapped TD targets (paper, equations 2 and 3)."""
    next_values = q_values(spec, hyper, target, batch.next_observation)
    next_value = jnp.max(next_values, axis=-1)
    if spec.double:
        next_action = jnp.argmax(q_values(spec, hyper, weights, batch.next_observation), axis=-1)
        next_value = jnp.sum(next_values * jax.nn.one_hot(next_action, spec.n_devices), axis=-1)
    td_target = batch.reward + (1.0 - batch.terminated) * batch.discount * next_value
    taken = jax.nn.one_hot(batch.action, spec.n_devices)
    value = jnp.sum(q_values(spec, hyper, weights, batch.observation) * taken, axis=-1)
    chex.assert_equal_shape([value, td_target])
    return jnp.mean(optax.huber_loss(value, td_target))


def _iteration(spec: DQNSpec, agent: Agent, state: DQNState, i: Int[Array, ""]) -> DQNState:
    """Make ``train_frequency`` environment steps, update the target network if it is due, and make one gradient step.

    All randomness of the iteration comes from a single draw: for each environment step one number for the task volume of
    each device, one that decides whether to explore and one for the random action; then one for each sample.
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
    buffer_state = replay.add(spec.replay, state.buffer_state, steps_done, jnp.stack(new_rows))
    steps_done += spec.train_frequency

    due = target_is_due(spec, agent.hyper, steps_done)
    target = jax.lax.cond(  # a real branch: the predicate is the same for all agents
        jax.lax.pmax(due, AGENTS_AXIS),
        lambda: update_target(due, agent.hyper.tau, state.weights, state.target),
        lambda: state.target,
    )
    batch = replay.sample(spec.replay, buffer_state, steps_done, bits[n_acting:], agent.hyper.gamma)
    state = replace(state, buffer_state=buffer_state, target=target)
    return _gradient_step(spec, agent.hyper, state, batch, steps_done)


def _act(
    spec: DQNSpec, agent: Agent, state: DQNState, steps_done: Int[Array, ""], uniform: Float[Array, " n_plus_2"]
) -> tuple[DQNState, UInt[Array, " words"]]:
    """Make one epsilon-greedy environment step; also return the transition's row for the replay buffer."""
    n, scenario = spec.n_devices, _scenario(agent)
    params, layout = scenario.params, scenario.layout
    greedy = greedy_action(spec, agent.hyper, state.weights, observe(params, layout, state.env_state))
    random = jnp.minimum((uniform[n + 1] * n).astype(jnp.int32), n - 1)
    warm_up = steps_done < agent.hyper.learning_starts
    explore = warm_up | (uniform[n] < epsilon(agent.hyper, spec.total_steps, steps_done))
    action = jnp.where(explore, random, greedy)

    after, reward, outcome = advance(scenario, state.env_state, action, draw_volumes(params, uniform[:n]))
    terminated = outcome.cause != Cause.NONE
    ended = terminated | is_truncated(scenario, after, outcome)
    row = replay.pack(spec.replay, action, reward, after.battery / layout.capacity, after.age, terminated, ended)
    state = replace(
        state,
        env_state=auto_reset(ended, scenario, state.env_state, after),
        episode_slots=state.episode_slots + jnp.where(ended, after.slot, 0),
        episodes=state.episodes + ended,
    )
    return state, row


def _gradient_step(
    spec: DQNSpec, hyper: DQNHyper, state: DQNState, batch: replay.Transition, steps_done: int | Int[Array, ""]
) -> DQNState:
    """Make one gradient step, unless the agent is still warming up or has diverged."""
    loss, gradient = jax.value_and_grad(lambda w: td_loss(spec, hyper, w, state.target, batch))(state.weights)
    train_state = apply_gradients(
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
    return replace(
        state,
        weights=train_state.weights,
        opt_state=train_state.opt_state,
        diverged_at=train_state.diverged_at,
        loss=loss,
    )

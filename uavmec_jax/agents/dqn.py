"""Deep Q-learning for one agent: as the paper ran it (Stable-Baselines3's DQN with Table 4), and its usual variants.

``init`` returns an agent's state before training, ``update`` runs some iterations; one iteration is ``train_frequency``
environment steps and one gradient step. The population (:mod:`uavmec_jax.training.population`) adds the agent axis with
``vmap``: the iteration number is shared by all agents and never batched; everything that belongs to one agent is batched.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, ArrayLike, Bool, Float, Int, UInt

from uavmec_jax.agents import episode, replay, state_replay
from uavmec_jax.agents.algorithm import AGENTS_AXIS, Agent, Algorithm
from uavmec_jax.agents.dqn_spec import DQNHyper, DQNSpec, DQNState
from uavmec_jax.agents.exploration import exploratory_action
from uavmec_jax.agents.networks import Weights, scale_ages
from uavmec_jax.agents.optimizers import TrainState, apply_gradients, clipped_adam, linear_decay
from uavmec_jax.agents.q_targets import values_of, widen_gap
from uavmec_jax.env.dynamics import Cause, initial_state
from uavmec_jax.env.scenario import advance, auto_reset, draw_volumes, is_truncated
from uavmec_jax.env.types import Scalar

__all__ = [
    "DQNHyper",
    "DQNSpec",
    "DQNState",
    "algorithm",
    "epsilon",
    "gradient_steps",
    "greedy_action",
    "init",
    "learning_rate",
    "q_values",
    "target_is_due",
    "td_loss",
    "update",
    "update_target",
]

_WEIGHTS_STREAM = 2**32 - 1
"""``fold_in`` number of the initial weights; the iterations use their own numbers, from 0."""


def algorithm(spec: DQNSpec) -> Algorithm:
    """Return the algorithm with its static settings bound.

    Raises:
        ValueError: there are more devices than the replay buffer can tell apart, or it keeps too few scenarios.
    """
    if spec.sees_paper and spec.n_devices > replay.MAX_ACTIONS:
        raise ValueError(
            f"n_devices is {spec.n_devices}; a DQN replay holds at most {replay.MAX_ACTIONS} devices; give "
            "observation = 'full', or take pqn, ppo or a2c"
        )
    if spec.scenario_ring < 2:  # that of the newest transition, and that of an episode that has just begun
        raise ValueError(f"scenario_ring is {spec.scenario_ring}; it should be at least 2")
    return Algorithm(
        name="dqn",
        iterations=spec.iterations,
        steps_per_iteration=spec.train_frequency,
        agent_bytes=spec.agent_bytes,
        init=partial(init, spec),
        update=partial(update, spec),
        greedy=partial(greedy_action, spec),
        observation_fn=spec.observation_spec.observation_fn,
    )


def init(spec: DQNSpec, agent: Agent) -> DQNState:
    """Return an agent's state before training: random weights, a target equal to them, an empty buffer, a new episode."""
    running = episode.start(agent, spec.scenarios_kept)
    scenario = episode.scenario_of(agent, running)
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
        average=jax.tree.map(jnp.copy, weights) if spec.average_weights else None,
        epsilon_share=jnp.float32(1) if spec.spread_epsilon else None,
        episode=running,
    )


def update(spec: DQNSpec, agent: Agent, state: DQNState, first: Int[Array, ""], last: Int[Array, ""]) -> DQNState:
    """Run the iterations ``first <= i < last`` of one agent; the bounds are shared by all agents. Call it under ``vmap``."""
    state = replace(state, episode_slots=jnp.int32(0), episodes=jnp.int32(0))
    return jax.lax.fori_loop(first, last, lambda i, carry: _iteration(spec, agent, carry, i), state)


def epsilon(hyper: DQNHyper, total_steps: int, steps_done: Int[ArrayLike, ""]) -> Float[Array, ""]:
    """Return the exploration rate after ``steps_done`` environment steps: it falls linearly, then stays constant."""
    progress = jnp.asarray(steps_done, jnp.float32) / total_steps
    done = jnp.minimum(progress / hyper.exploration_fraction, 1.0)
    return hyper.exploration_initial_eps + done * (hyper.exploration_final_eps - hyper.exploration_initial_eps)


def learning_rate(spec: DQNSpec, hyper: DQNHyper, steps_done: int | Int[Array, ""]) -> Scalar:
    """Return the learning rate of the iteration that ends at ``steps_done``; it falls linearly over all iterations."""
    iterations_before = steps_done // spec.train_frequency - 1
    return linear_decay(hyper.learning_rate, hyper.learning_rate_final, iterations_before / spec.iterations)


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
    """Return the Q-values of all actions; the ages of the paper's observation are multiplied by ``age_scale``."""
    if spec.sees_paper:
        values: Any = spec.network.apply(weights, scale_ages(observation, hyper.age_scale))
        return values
    values = spec.network.apply(weights, observation.reshape(-1, observation.shape[-1]))
    return values.reshape(*observation.shape[:-1], -1)


def greedy_action(
    spec: DQNSpec, hyper: DQNHyper, weights: Weights, observation: Float[Array, "*b obs_size"]
) -> Int[Array, "*b"]:
    """Return the action with the highest Q-value; ties go to the lowest number."""
    return jnp.argmax(q_values(spec, hyper, weights, observation), axis=-1).astype(jnp.int32)


def td_loss(
    spec: DQNSpec, hyper: DQNHyper, weights: Weights, target: Weights, batch: replay.Transition
) -> Float[Array, ""]:
    """Return the Huber loss of a minibatch against its bootstrapped TD targets (paper, equations 2 and 3)."""
    if spec.advantage_learning:  # one pass of the target network
        both = q_values(spec, hyper, target, jnp.concatenate([batch.observation, batch.next_observation]))
        old_values, next_values = jnp.split(both, 2)
    else:
        next_values = q_values(spec, hyper, target, batch.next_observation)
    next_value = jnp.max(next_values, axis=-1)
    if spec.double:
        next_action = jnp.argmax(q_values(spec, hyper, weights, batch.next_observation), axis=-1)
        next_value = values_of(next_values, next_action)
    td_target = batch.reward + (1.0 - batch.terminated) * batch.discount * next_value
    if spec.advantage_learning:
        td_target = widen_gap(td_target, old_values, batch.action, hyper.gap)
    value = values_of(q_values(spec, hyper, weights, batch.observation), batch.action)
    chex.assert_equal_shape([value, td_target])
    return jnp.mean(optax.huber_loss(value, td_target))


def _iteration(spec: DQNSpec, agent: Agent, state: DQNState, i: Int[Array, ""]) -> DQNState:
    """Make ``train_frequency`` environment steps, update the target network if it is due, and make one gradient step.

    All randomness of the iteration comes from a single draw: ``numbers_per_step`` numbers for each environment step, then one
    for each sample.
    """
    steps_done = i * spec.train_frequency
    per_step = spec.numbers_per_step
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
    state = replace(state, buffer_state=buffer_state, target=target)
    batch = _sample(spec, agent, state, steps_done, bits[n_acting:])
    return _gradient_step(spec, agent.hyper, state, batch, steps_done)


def _act(
    spec: DQNSpec, agent: Agent, state: DQNState, steps_done: Int[Array, ""], uniform: Float[Array, " numbers"]
) -> tuple[DQNState, UInt[Array, " words"]]:
    """Make one epsilon-greedy environment step; also return the transition's row for the replay buffer."""
    n, scenario = spec.n_devices, episode.scenario_of(agent, state.episode)
    params, layout = scenario.params, scenario.layout
    observation = spec.observation_spec.observation_fn(params, layout, state.env_state)
    greedy = greedy_action(spec, agent.hyper, state.weights, observation)
    # Without a guide, the first of the last two numbers is not used.
    exploratory = exploratory_action(scenario, state.env_state, spec.guide, agent.hyper.guidance, uniform[-2:])
    warm_up = steps_done < agent.hyper.learning_starts
    share = state.epsilon_share
    rate = epsilon(agent.hyper, spec.total_steps, steps_done)
    explore = warm_up | (uniform[n] < (rate if share is None else rate * share))
    action = jnp.where(explore, exploratory, greedy)

    after, reward, outcome = advance(scenario, state.env_state, action, draw_volumes(params, uniform[:n]))
    terminated = outcome.cause != Cause.NONE
    ended = terminated | is_truncated(scenario, after, outcome)
    if share is not None:  # log-uniform between the spread and 1
        share = jnp.where(ended, agent.hyper.exploration_spread ** uniform[n + 1], share)
    buffer = spec.replay
    if isinstance(buffer, replay.ReplaySpec):
        row = replay.pack(buffer, action, reward, after.battery / layout.capacity, after.age, terminated, ended)
    else:
        number = jnp.int32(0) if state.episode is None else state.episode.number
        row = state_replay.pack(buffer, action, reward, after, number, terminated, ended)
    running = episode.follow(agent, state.episode, ended, steps_done + 1)
    next_scenario = episode.scenario_of(agent, running)
    state = replace(
        state,
        env_state=auto_reset(ended, next_scenario, state.env_state, after),
        episode=running,
        episode_slots=state.episode_slots + jnp.where(ended, after.slot, 0),
        episodes=state.episodes + ended,
        epsilon_share=share,
    )
    return state, row


def _sample(
    spec: DQNSpec, agent: Agent, state: DQNState, steps_done: Int[Array, ""], bits: UInt[Array, " B"]
) -> replay.Transition:
    """Sample a minibatch; ``bits`` has one uniform word for each sample."""
    buffer, arguments = spec.replay, (state.buffer_state, steps_done, bits, agent.hyper.gamma)
    if isinstance(buffer, replay.ReplaySpec):
        return replay.sample(buffer, *arguments)
    return state_replay.sample(
        buffer,
        *arguments,
        oldest=episode.oldest_transition(state.episode),
        scenario_of=partial(episode.kept_scenario, agent, state.episode),
        observation_fn=spec.observation_spec.observation_fn,
    )


def _gradient_step(
    spec: DQNSpec, hyper: DQNHyper, state: DQNState, batch: replay.Transition, steps_done: int | Int[Array, ""]
) -> DQNState:
    """Make one gradient step and average the weights, unless the agent is still warming up or has diverged."""
    learning = steps_done > hyper.learning_starts
    loss, gradient = jax.value_and_grad(lambda w: td_loss(spec, hyper, w, state.target, batch))(state.weights)
    train_state = apply_gradients(
        clipped_adam(),
        TrainState(state.weights, state.opt_state, state.diverged_at),
        loss,
        gradient,
        learning_rate=learning_rate(spec, hyper, steps_done),
        max_norm=hyper.max_grad_norm,
        count=gradient_steps(spec, hyper, steps_done),
        steps_done=steps_done,
        learning=learning,
    )
    average = state.average
    if average is not None:  # it follows the weights as a target network with soft updates does
        average = update_target(learning, 1.0 - hyper.average_decay, train_state.weights, average)
    return replace(
        state,
        weights=train_state.weights,
        opt_state=train_state.opt_state,
        diverged_at=train_state.diverged_at,
        loss=loss,
        average=average,
    )

"""Parallelised Q-learning (PQN, Gallici et al., 2025) for one agent: no replay and no target network.

One iteration plays ``n_steps`` slots in each of an agent's ``n_envs`` environments, computes lambda-returns from the
Q-values of that moment, and makes ``n_epochs`` passes over these samples. Layer normalisation keeps the learning stable. What
differs from the publication is a setting: Watkins' cut, the gap (:mod:`uavmec_jax.agents.q_targets`), epsilons that differ
between environments, guided exploration (:mod:`uavmec_jax.agents.exploration`), averaged weights.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from uavmec_jax.agents import environments
from uavmec_jax.agents.algorithm import AGENTS_AXIS, Agent, Algorithm
from uavmec_jax.agents.exploration import exploratory_action, spread_epsilons
from uavmec_jax.agents.networks import Weights, scale_ages
from uavmec_jax.agents.optimizers import TrainState, apply_gradients, clipped_adam, linear_decay
from uavmec_jax.agents.pqn_spec import PQNHyper, PQNSpec, PQNState
from uavmec_jax.agents.q_targets import lambda_returns, values_of, widen_gap
from uavmec_jax.agents.shuffle import permutation
from uavmec_jax.env.dynamics import State
from uavmec_jax.env.scenario import Scenario

__all__ = [
    "PQNHyper",
    "PQNSpec",
    "PQNState",
    "Samples",
    "algorithm",
    "collect_samples",
    "greedy_action",
    "init",
    "pqn_loss",
    "q_values",
    "train_epoch",
    "update",
]

_WEIGHTS_STREAM = 2**32 - 1
"""``fold_in`` number of the initial weights; the iterations use their own numbers, from 0."""
_OPTIMIZER = clipped_adam()


class Samples(NamedTuple):
    """A batch of samples for a gradient step: observation, action, and the target of the action's Q-value."""

    observation: Float[Array, "*batch B obs_size"]
    action: Int[Array, "*batch B"]
    target: Float[Array, "*batch B"]


class _Slot(NamedTuple):
    """One slot in every environment: observation and Q-values before it, action, reward, and whether an episode ended."""

    observation: Float[Array, "*t e obs_size"]
    q_values: Float[Array, "*t e n"]
    action: Int[Array, "*t e"]
    reward: Float[Array, "*t e"]
    ended: Bool[Array, "*t e"]


def algorithm(spec: PQNSpec) -> Algorithm:
    """Return the algorithm with its static settings bound.

    Raises:
        ValueError: the minibatch does not divide the rollout.
    """
    if spec.steps_per_iteration % spec.batch_size:
        raise ValueError(
            f"batch_size is {spec.batch_size}; it should divide n_steps * n_envs = {spec.steps_per_iteration}"
        )
    return Algorithm(
        name="pqn",
        iterations=spec.iterations,
        steps_per_iteration=spec.steps_per_iteration,
        agent_bytes=spec.agent_bytes,
        init=partial(init, spec),
        update=partial(update, spec),
        greedy=partial(greedy_action, spec),
        observation_fn=spec.observation_spec.observation_fn,
    )


def init(spec: PQNSpec, agent: Agent) -> PQNState:
    """Return an agent's state before training: random weights, and a new episode in every environment."""
    weights = spec.network.init(jax.random.fold_in(agent.key, _WEIGHTS_STREAM), jnp.zeros((1, spec.obs_size)))
    started = environments.start(agent, spec.n_envs)
    return PQNState(
        weights=weights,
        average=jax.tree.map(jnp.copy, weights) if spec.average_weights else None,
        opt_state=_OPTIMIZER.init(weights),
        env_states=started.states,
        diverged_at=jnp.int32(-1),
        episode_slots=jnp.int32(0),
        episodes=jnp.int32(0),
        loss=jnp.float32(0),
        scenarios=started.scenarios,
    )


def update(spec: PQNSpec, agent: Agent, state: PQNState, first: Int[Array, ""], last: Int[Array, ""]) -> PQNState:
    """Run the iterations ``first <= i < last`` of one agent; the bounds are shared by all agents. Call it under ``vmap``."""
    state = replace(state, episode_slots=jnp.int32(0), episodes=jnp.int32(0))
    return jax.lax.fori_loop(first, last, lambda i, carry: _iteration(spec, agent, carry, i), state)


def q_values(
    spec: PQNSpec, hyper: PQNHyper, weights: Weights, observation: Float[Array, "b obs_size"]
) -> Float[Array, "b n"]:
    """Return the Q-values of all actions; the ages of the paper's observation are multiplied by ``age_scale``."""
    paper = spec.observation == "paper"
    values: Any = spec.network.apply(weights, scale_ages(observation, hyper.age_scale) if paper else observation)
    return values


def greedy_action(
    spec: PQNSpec, hyper: PQNHyper, weights: Weights, observation: Float[Array, "*b obs_size"]
) -> Int[Array, "*b"]:
    """Return the action with the highest Q-value; ties go to the lowest number."""
    rows = observation.reshape(-1, observation.shape[-1])
    action = jnp.argmax(q_values(spec, hyper, weights, rows), axis=-1).astype(jnp.int32)
    return action.reshape(observation.shape[:-1])


def pqn_loss(spec: PQNSpec, hyper: PQNHyper, weights: Weights, batch: Samples) -> Float[Array, ""]:
    """Return the loss of a minibatch: half the mean squared error of the Q-values (Gallici et al., 2025, algorithm 1)."""
    value = values_of(q_values(spec, hyper, weights, batch.observation), batch.action)
    chex.assert_equal_shape([value, batch.target])
    return 0.5 * jnp.mean(jnp.square(value - batch.target))


def _iteration(spec: PQNSpec, agent: Agent, state: PQNState, i: Int[Array, ""]) -> PQNState:
    """Play a rollout, make ``n_epochs`` passes over it, each in a new random order, and average the weights."""
    rollout_key, *epoch_keys = jax.random.split(jax.random.fold_in(agent.key, i), 1 + spec.n_epochs)
    state, samples = collect_samples(spec, agent, state, rollout_key)
    rows, updates_done = _rows(samples), i * spec.n_epochs * spec.minibatches
    hyper = agent.hyper

    def epoch(carry: tuple[TrainState, Array], numbered: tuple[Array, PRNGKeyArray]) -> tuple[Any, None]:
        number, key = numbered
        shuffled = rows[permutation(key, rows.shape[0])]
        return train_epoch(spec, hyper, carry[0], shuffled, updates_done + number * spec.minibatches + 1), None

    train_state = TrainState(state.weights, state.opt_state, state.diverged_at)
    numbered = (jnp.arange(spec.n_epochs), jnp.stack(epoch_keys))
    (train_state, loss), _ = jax.lax.scan(epoch, (train_state, state.loss), numbered)
    average = state.average
    if average is not None:
        keep = hyper.average_decay
        average = jax.tree.map(lambda old, new: keep * old + (1.0 - keep) * new, average, train_state.weights)
    return replace(
        state,
        weights=train_state.weights,
        average=average,
        opt_state=train_state.opt_state,
        diverged_at=train_state.diverged_at,
        loss=loss,
    )


def train_epoch(
    spec: PQNSpec, hyper: PQNHyper, train_state: TrainState, rows: Float[Array, "size row"], count: int | Int[Array, ""]
) -> tuple[TrainState, Float[Array, ""]]:
    """Make a gradient step on each minibatch, in the order of the rows, and return the last loss, too.

    Args:
        spec: static settings.
        hyper: hyperparameters.
        train_state: weights and optimiser state before the epoch.
        rows: the samples, one row each, already shuffled.
        count: number of the first of these gradient steps, from 1.
    """
    batches = rows.reshape(spec.minibatches, spec.batch_size, -1)
    total, per_iteration = spec.iterations * spec.n_epochs * spec.minibatches, spec.n_epochs * spec.minibatches

    def gradient_step(carry: tuple[TrainState, Array], numbered: tuple[Array, Array]) -> tuple[Any, None]:
        number, batch = numbered
        loss, gradient = jax.value_and_grad(lambda w: pqn_loss(spec, hyper, w, _samples(batch)))(carry[0].weights)
        done = count + number - 1
        train_state = apply_gradients(
            _OPTIMIZER,
            carry[0],
            loss,
            gradient,
            learning_rate=linear_decay(hyper.learning_rate, hyper.learning_rate_final, done / total),
            max_norm=hyper.max_grad_norm,
            count=done + 1,
            steps_done=(done // per_iteration + 1) * spec.steps_per_iteration,
        )
        return (train_state, loss), None

    return jax.lax.scan(gradient_step, (train_state, jnp.float32(0)), (jnp.arange(spec.minibatches), batches))[0]


def collect_samples(spec: PQNSpec, agent: Agent, state: PQNState, key: PRNGKeyArray) -> tuple[PQNState, Samples]:
    """Play ``n_steps`` slots in every environment and return ``n_steps * n_envs`` samples, environments innermost.

    All randomness of the slots comes from a single draw: for each slot and environment one number for the task volume of
    each device and three for the action.
    """
    hyper, observation_fn = agent.hyper, spec.observation_spec.observation_fn
    bits = jax.random.bits(key, (spec.n_steps, spec.n_envs, spec.n_devices + 3))

    def play_slot(state: PQNState, numbered: tuple[Array, Array]) -> tuple[PQNState, _Slot]:
        number, bits = numbered
        uniform = (bits >> 8).astype(jnp.float32) * 2.0**-24
        return _play_slot(spec, agent, state, uniform, jax.random.fold_in(key, number))

    state, slots = jax.lax.scan(play_slot, state, (jnp.arange(spec.n_steps), bits))
    last = q_values(spec, hyper, state.weights, environments.observe(agent, state.environments, observation_fn))
    value = jnp.max(slots.q_values, axis=-1)
    greedy = jnp.full(value.shape, True)
    if spec.cut_traces:
        greedy = values_of(slots.q_values, slots.action) >= value
    target = lambda_returns(
        slots.reward, value, jnp.max(last, axis=-1), slots.ended, greedy, hyper.gamma, hyper.q_lambda
    )
    target = widen_gap(target, slots.q_values, slots.action, hyper.gap)
    return state, Samples(slots.observation.reshape(-1, spec.obs_size), slots.action.reshape(-1), target.reshape(-1))


def _play_slot(
    spec: PQNSpec, agent: Agent, state: PQNState, uniform: Float[Array, "e n_plus_3"], key: PRNGKeyArray
) -> tuple[PQNState, _Slot]:
    """Play one slot in every environment.

    Where the time limit alone ended an episode, the discounted value of the state it was cut off in is added to the reward.
    """
    n, hyper, envs = spec.n_devices, agent.hyper, state.environments
    observation_fn = spec.observation_spec.observation_fn
    observation = environments.observe(agent, envs, observation_fn)
    values = q_values(spec, hyper, state.weights, observation)

    def explore(scenario: Scenario, env_state: State, uniform: Float[Array, " 2"]) -> Int[Array, ""]:
        return exploratory_action(scenario, env_state, spec.guide, hyper.guidance, uniform)

    exploratory = environments.over_environments(agent, envs, explore, envs.states, uniform[:, n + 1 :])
    epsilon = spread_epsilons(hyper.exploration_highest_eps, hyper.exploration_lowest_eps, spec.n_envs)
    greedy = jnp.argmax(values, axis=-1).astype(jnp.int32)
    action = jnp.where(uniform[:, n] < epsilon, exploratory, greedy)
    step = environments.step(agent, envs, action, uniform[:, :n])

    def bootstrapped_reward() -> Float[Array, " e"]:
        last = environments.observe(agent, envs._replace(states=step.after), observation_fn)
        next_value = jnp.max(q_values(spec, hyper, state.weights, last), axis=-1)
        return step.reward + jnp.where(step.truncated, hyper.gamma * next_value, 0.0)

    # a real branch: the predicate is the same for all agents
    any_truncated = jax.lax.pmax(jnp.any(step.truncated), AGENTS_AXIS)
    reward = jax.lax.cond(any_truncated, bootstrapped_reward, lambda: step.reward)
    new_envs = environments.start_ended(agent, envs, step.ended, step.after, key)
    state = replace(
        state,
        env_states=new_envs.states,
        scenarios=new_envs.scenarios,
        episode_slots=state.episode_slots + jnp.sum(jnp.where(step.ended, step.after.slot, 0)),
        episodes=state.episodes + jnp.sum(step.ended),
    )
    return state, _Slot(observation, values, action, reward, step.ended)


def _rows(samples: Samples) -> Float[Array, "size row"]:
    """Pack each sample into one row, so that a shuffle moves whole rows."""
    action = jax.lax.bitcast_convert_type(samples.action, jnp.float32)
    return jnp.concatenate([samples.observation, jnp.stack([action, samples.target], axis=-1)], axis=-1)


def _samples(rows: Float[Array, "b row"]) -> Samples:
    """Unpack the samples of rows."""
    return Samples(rows[:, :-2], jax.lax.bitcast_convert_type(rows[:, -2], jnp.int32), rows[:, -1])

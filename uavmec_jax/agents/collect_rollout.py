"""What an actor and a critic learn from: slots played in a few environments, with generalized_advantages and returns."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from uavmec_jax.agents import on_policy
from uavmec_jax.agents.algorithm import AGENTS_AXIS, Agent
from uavmec_jax.agents.gae import generalized_advantages, log_probability, sample_action
from uavmec_jax.agents.on_policy import OnPolicySpec, OnPolicyState
from uavmec_jax.env.dynamics import Cause, State, initial_state
from uavmec_jax.env.generator import sample_scenario
from uavmec_jax.env.scenario import Scenario, advance, auto_reset, draw_volumes, is_truncated


class Samples(NamedTuple):
    """What a gradient is taken on, leading axis ``B``.

    ``observation`` f32 ``[B, obs_size]``, ``action`` int32 ``[B]``, ``advantage``, ``returns`` f32 ``[B]``, and ``log_prob``
    f32 ``[B]``, the log-probability of the action when it was taken.
    """

    observation: Array
    action: Array
    advantage: Array
    returns: Array
    log_prob: Array


def collect_rollout(
    spec: OnPolicySpec, agent: Agent, state: OnPolicyState, key: PRNGKeyArray
) -> tuple[OnPolicyState, Samples]:
    """Play ``n_steps`` slots in every environment; returns ``n_steps * n_envs`` samples, environments innermost.

    All randomness of the slots is one draw: per slot and environment a volume for each device, and one number for the
    action. Where the agent plays a distribution, every episode that ends is followed by one in a fresh scenario.
    """
    n, hyper, weights = spec.n_devices, agent.hyper, state.weights
    bits = jax.random.bits(key, (spec.n_steps, spec.n_envs, n + 1))

    def slot(state: OnPolicyState, numbered: tuple[Any, Any]) -> tuple[OnPolicyState, tuple]:
        number, bits = numbered
        uniform = (bits >> 8).astype(jnp.float32) * 2.0**-24
        return _slot(spec, agent, state, uniform, jax.random.fold_in(key, number))

    state, (observation, action, reward, ended) = jax.lax.scan(slot, state, (jnp.arange(spec.n_steps), bits))
    flat = observation.reshape(-1, spec.obs_size)
    scores, values = on_policy.both(spec, hyper, weights, flat)
    values = values.reshape(reward.shape)
    ahead = on_policy.value(spec, hyper, weights, _see(spec, *_played(agent, state), state.env_states))
    advantage = generalized_advantages(reward, values, ahead, ended, hyper.gamma, hyper.gae_lambda)
    taken = action.reshape(-1)
    return state, Samples(
        observation=flat,
        action=taken,
        advantage=advantage.reshape(-1),
        returns=(advantage + values).reshape(-1),
        log_prob=log_probability(scores, taken)[0],
    )


def _played(agent: Agent, state: OnPolicyState) -> tuple[Scenario, int | None]:
    """What the environments collect_rollout, and its axis: one for each of them, or one for all."""
    return (agent.scenario, None) if state.scenarios is None else (state.scenarios, 0)


def _see(spec: OnPolicySpec, scenario: Scenario, axis: int | None, env_states: State) -> Float[Array, "e obs_size"]:
    """What is seen of every environment."""
    see = lambda scenario, env_state: spec.observation_spec.observation_fn(scenario.params, scenario.layout, env_state)  # noqa: E731
    return jax.vmap(see, (axis, 0))(scenario, env_states)


def _slot(
    spec: OnPolicySpec,
    agent: Agent,
    state: OnPolicyState,
    uniform: Float[Array, "e n_plus_1"],
    key: PRNGKeyArray,
) -> tuple[OnPolicyState, tuple[Array, Array, Array, Array]]:
    """One slot in every environment: observations before it, actions, rewards, whether an episode ended.

    Where the time limit alone ended an episode, the reward holds the discounted value of what was cut off.
    """
    n = spec.n_devices
    scenario, axis = _played(agent, state)
    over_envs = lambda function, *arguments: jax.vmap(function, (axis, *(0 for _ in arguments)))(scenario, *arguments)  # noqa: E731
    observation = _see(spec, scenario, axis, state.env_states)
    action = sample_action(on_policy.logits(spec, agent.hyper, state.weights, observation), uniform[:, n])
    volumes = over_envs(lambda scenario, drawn: draw_volumes(scenario.params, drawn), uniform[:, :n])
    after, reward, outcome = over_envs(advance, state.env_states, action, volumes)
    truncated = over_envs(is_truncated, after, outcome)
    ended = (outcome.cause != Cause.NONE) | truncated

    def with_cut_off() -> Array:
        worth = on_policy.value(spec, agent.hyper, state.weights, _see(spec, scenario, axis, after))
        return reward + jnp.where(truncated, agent.hyper.gamma * worth, 0.0)

    cut = jax.lax.pmax(jnp.any(truncated), AGENTS_AXIS)  # a true branch: the predicate is the same for all agents
    reward = jax.lax.cond(cut, with_cut_off, lambda: reward)
    state = replace(
        _restarted(agent, state, ended, after, key),
        episode_slots=state.episode_slots + jnp.sum(jnp.where(ended, after.slot, 0)),
        episodes=state.episodes + jnp.sum(ended),
    )
    return state, (observation, action, reward, ended)


def _restarted(
    agent: Agent, state: OnPolicyState, ended: Bool[Array, " e"], after: State, key: PRNGKeyArray
) -> OnPolicyState:
    """The environments after a slot: new episodes where one has ended, in fresh scenarios if the agent plays many."""
    if state.scenarios is None:
        restart = lambda end, env_state: auto_reset(end, agent.scenario, env_state)  # noqa: E731
        return replace(state, env_states=jax.vmap(restart)(ended, after))
    fresh = jax.vmap(partial(sample_scenario, agent.scenario))(jax.random.split(key, ended.shape[0]))
    begun = jax.vmap(initial_state)(fresh.params, fresh.layout)

    def choose_leaf(new: Array, old: Array) -> Array:
        return jnp.where(ended.reshape(-1, *(1 for _ in new.shape[1:])), new, old)

    scenarios, env_states = jax.tree.map(choose_leaf, (fresh, begun), (state.scenarios, after))
    return replace(state, scenarios=scenarios, env_states=env_states)

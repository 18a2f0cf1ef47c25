"""The samples that PPO and A2C learn from: slots played in an agent's environments, with advantages and returns."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from uavmec_jax.agents import actor_critic
from uavmec_jax.agents.actor_critic import ActorCriticSpec, ActorCriticState
from uavmec_jax.agents.algorithm import AGENTS_AXIS, Agent
from uavmec_jax.agents.gae import generalized_advantages, log_prob_and_entropy, sample_action
from uavmec_jax.env.dynamics import Cause, State, initial_state
from uavmec_jax.env.generator import sample_scenario
from uavmec_jax.env.scenario import Scenario, advance, auto_reset, draw_volumes, is_truncated


class Samples(NamedTuple):
    """A batch of samples for a gradient step.

    Attributes:
        observation: what the policy saw.
        action: what it did.
        advantage: generalised advantage estimate of the action.
        returns: estimate of the return, the target of the value network.
        log_prob: log-probability of the action when it was sampled.
    """

    observation: Float[Array, "*batch B obs_size"]
    action: Int[Array, "*batch B"]
    advantage: Float[Array, "*batch B"]
    returns: Float[Array, "*batch B"]
    log_prob: Float[Array, "*batch B"]


class _Slot(NamedTuple):
    """One slot in every environment: observation before it, action, reward, and whether an episode ended."""

    observation: Float[Array, "*t e obs_size"]
    action: Int[Array, "*t e"]
    reward: Float[Array, "*t e"]
    ended: Bool[Array, "*t e"]


def collect_rollout(
    spec: ActorCriticSpec, agent: Agent, state: ActorCriticState, key: PRNGKeyArray
) -> tuple[ActorCriticState, Samples]:
    """Play ``n_steps`` slots in every environment and return ``n_steps * n_envs`` samples, environments innermost.

    All randomness of the slots comes from a single draw: for each slot and environment one number for the task volume of
    each device and one for the action. If the agent has a distribution, each new episode is in a newly drawn scenario.
    """
    n, hyper, weights = spec.n_devices, agent.hyper, state.weights
    bits = jax.random.bits(key, (spec.n_steps, spec.n_envs, n + 1))

    def play_slot(state: ActorCriticState, numbered: tuple[Array, Array]) -> tuple[ActorCriticState, _Slot]:
        number, bits = numbered
        uniform = (bits >> 8).astype(jnp.float32) * 2.0**-24
        return _play_slot(spec, agent, state, uniform, jax.random.fold_in(key, number))

    state, slots = jax.lax.scan(play_slot, state, (jnp.arange(spec.n_steps), bits))
    observation, action = slots.observation.reshape(-1, spec.obs_size), slots.action.reshape(-1)
    logits, values = actor_critic.logits_and_value(spec, hyper, weights, observation)
    values = values.reshape(slots.reward.shape)
    last_observation = _observe(spec, *_scenarios_and_axis(agent, state), state.env_states)
    last_value = actor_critic.value(spec, hyper, weights, last_observation)
    advantage = generalized_advantages(slots.reward, values, last_value, slots.ended, hyper.gamma, hyper.gae_lambda)
    return state, Samples(
        observation=observation,
        action=action,
        advantage=advantage.reshape(-1),
        returns=(advantage + values).reshape(-1),
        log_prob=log_prob_and_entropy(logits, action)[0],
    )


def _scenarios_and_axis(agent: Agent, state: ActorCriticState) -> tuple[Any, int | None]:
    """Return the environments' scenarios and their ``vmap`` axis: one scenario each, or one for all (``None``)."""
    return (agent.scenario, None) if state.scenarios is None else (state.scenarios, 0)


def _observe(
    spec: ActorCriticSpec, scenarios: Scenario, axis: int | None, env_states: State
) -> Float[Array, "e obs_size"]:
    """Return the observation of every environment."""
    observation_fn = spec.observation_spec.observation_fn
    observe = lambda scenario, env_state: observation_fn(scenario.params, scenario.layout, env_state)  # noqa: E731
    return jax.vmap(observe, (axis, 0))(scenarios, env_states)


def _play_slot(
    spec: ActorCriticSpec,
    agent: Agent,
    state: ActorCriticState,
    uniform: Float[Array, "e n_plus_1"],
    key: PRNGKeyArray,
) -> tuple[ActorCriticState, _Slot]:
    """Play one slot in every environment.

    Where the time limit alone ended an episode, the discounted value of the state it was cut off in is added to the reward.
    """
    n = spec.n_devices
    scenarios, axis = _scenarios_and_axis(agent, state)
    over_envs = lambda function, *arguments: jax.vmap(function, (axis, *(0 for _ in arguments)))(scenarios, *arguments)  # noqa: E731
    observation = _observe(spec, scenarios, axis, state.env_states)
    action = sample_action(actor_critic.logits(spec, agent.hyper, state.weights, observation), uniform[:, n])
    volumes = over_envs(lambda scenario, drawn: draw_volumes(scenario.params, drawn), uniform[:, :n])
    after, reward, outcome = over_envs(advance, state.env_states, action, volumes)
    truncated = over_envs(is_truncated, after, outcome)
    ended = (outcome.cause != Cause.NONE) | truncated

    def bootstrapped_reward() -> Float[Array, " e"]:
        next_value = actor_critic.value(spec, agent.hyper, state.weights, _observe(spec, scenarios, axis, after))
        return reward + jnp.where(truncated, agent.hyper.gamma * next_value, 0.0)

    # a real branch: the predicate is the same for all agents
    any_truncated = jax.lax.pmax(jnp.any(truncated), AGENTS_AXIS)
    reward = jax.lax.cond(any_truncated, bootstrapped_reward, lambda: reward)
    state = replace(
        _reset_ended(agent, state, ended, after, key),
        episode_slots=state.episode_slots + jnp.sum(jnp.where(ended, after.slot, 0)),
        episodes=state.episodes + jnp.sum(ended),
    )
    return state, _Slot(observation, action, reward, ended)


def _reset_ended(
    agent: Agent, state: ActorCriticState, ended: Bool[Array, " e"], after: State, key: PRNGKeyArray
) -> ActorCriticState:
    """Start new episodes where one has ended, in newly drawn scenarios if the agent has a distribution."""
    scenario = agent.scenario
    if isinstance(scenario, Scenario):
        env_states = jax.vmap(auto_reset, (0, None, 0, 0))(ended, scenario, state.env_states, after)
        return replace(state, env_states=env_states)
    new_scenarios = jax.vmap(partial(sample_scenario, scenario))(jax.random.split(key, ended.shape[0]))
    new_states = jax.vmap(initial_state)(new_scenarios.params, new_scenarios.layout)

    def select(new: Array, old: Array) -> Array:
        return jnp.where(ended.reshape(-1, *(1 for _ in new.shape[1:])), new, old)

    scenarios, env_states = jax.tree.map(select, (new_scenarios, new_states), (state.scenarios, after))
    return replace(state, scenarios=scenarios, env_states=env_states)

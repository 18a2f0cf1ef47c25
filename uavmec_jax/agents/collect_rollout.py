"""The samples that PPO and A2C learn from: slots played in an agent's environments, with advantages and returns."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from uavmec_jax.agents import actor_critic, environments
from uavmec_jax.agents.actor_critic import ActorCriticSpec, ActorCriticState
from uavmec_jax.agents.algorithm import AGENTS_AXIS, Agent
from uavmec_jax.agents.gae import generalized_advantages, log_prob_and_entropy, sample_action


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
    n, hyper, weights, observation_fn = spec.n_devices, agent.hyper, state.weights, spec.observation_spec.observation_fn
    bits = jax.random.bits(key, (spec.n_steps, spec.n_envs, n + 1))

    def play_slot(state: ActorCriticState, numbered: tuple[Array, Array]) -> tuple[ActorCriticState, _Slot]:
        number, bits = numbered
        uniform = (bits >> 8).astype(jnp.float32) * 2.0**-24
        return _play_slot(spec, agent, state, uniform, jax.random.fold_in(key, number))

    state, slots = jax.lax.scan(play_slot, state, (jnp.arange(spec.n_steps), bits))
    observation, action = slots.observation.reshape(-1, spec.obs_size), slots.action.reshape(-1)
    logits, values = actor_critic.logits_and_value(spec, hyper, weights, observation)
    values = values.reshape(slots.reward.shape)
    last_observation = environments.observe(agent, state.environments, observation_fn)
    last_value = actor_critic.value(spec, hyper, weights, last_observation)
    advantage = generalized_advantages(slots.reward, values, last_value, slots.ended, hyper.gamma, hyper.gae_lambda)
    return state, Samples(
        observation=observation,
        action=action,
        advantage=advantage.reshape(-1),
        returns=(advantage + values).reshape(-1),
        log_prob=log_prob_and_entropy(logits, action)[0],
    )


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
    n, envs, observation_fn = spec.n_devices, state.environments, spec.observation_spec.observation_fn
    observation = environments.observe(agent, envs, observation_fn)
    action = sample_action(actor_critic.logits(spec, agent.hyper, state.weights, observation), uniform[:, n])
    step = environments.step(agent, envs, action, uniform[:, :n])

    def bootstrapped_reward() -> Float[Array, " e"]:
        last = environments.observe(agent, envs._replace(states=step.after), observation_fn)
        next_value = actor_critic.value(spec, agent.hyper, state.weights, last)
        return step.reward + jnp.where(step.truncated, agent.hyper.gamma * next_value, 0.0)

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
    return state, _Slot(observation, action, reward, step.ended)

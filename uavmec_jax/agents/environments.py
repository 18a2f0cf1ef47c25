"""The environments of one agent that learns from rollouts: they start, take a step together, and start anew."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from uavmec_jax.agents.algorithm import Agent
from uavmec_jax.env.dynamics import Cause, State, initial_state
from uavmec_jax.env.generator import sample_scenario
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.scenario import Scenario, advance, auto_reset, draw_volumes, is_truncated

SCENARIOS_STREAM = 2**32 - 2
"""``fold_in`` number of the initial scenarios; the iterations use their own numbers, from 0."""


class Environments(NamedTuple):
    """The environments of an agent.

    Attributes:
        states: their states, leaves ``[n_envs, ...]``.
        scenarios: their scenarios, leaves ``[n_envs, ...]``; ``None`` if all have the agent's.
    """

    states: State
    scenarios: Scenario | None


class Step(NamedTuple):
    """What one slot did in every environment.

    Attributes:
        after: the states after the slot, before new episodes start.
        reward: the rewards.
        ended: whether an episode ended.
        truncated: whether the time limit alone ended it.
    """

    after: State
    reward: Float[Array, " e"]
    ended: Bool[Array, " e"]
    truncated: Bool[Array, " e"]


def start(agent: Agent, n_envs: int) -> Environments:
    """Start an episode in every environment; if the agent has a distribution, each in a scenario drawn from it."""
    if isinstance(agent.scenario, Scenario):
        state = initial_state(agent.scenario.params, agent.scenario.layout)
        return Environments(jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n_envs, *jnp.shape(leaf))), state), None)
    keys = jax.random.split(jax.random.fold_in(agent.key, SCENARIOS_STREAM), n_envs)
    scenarios = jax.vmap(partial(sample_scenario, agent.scenario))(keys)
    return Environments(jax.vmap(initial_state)(scenarios.params, scenarios.layout), scenarios)


def over_environments(agent: Agent, environments: Environments, function: Any, *arguments: Any) -> Any:
    """Return ``function(scenario, *arguments)`` for every environment; the leaves of the arguments are ``[n_envs, ...]``."""
    axes = (0 for _ in arguments)
    if environments.scenarios is None:
        return jax.vmap(function, (None, *axes))(agent.scenario, *arguments)
    return jax.vmap(function, (0, *axes))(environments.scenarios, *arguments)


def observe(
    agent: Agent, environments: Environments, observation_fn: Callable[[Params, Layout, State], Array]
) -> Float[Array, "e obs_size"]:
    """Return the observation of every environment."""

    def of_one(scenario: Scenario, state: State) -> Array:
        return observation_fn(scenario.params, scenario.layout, state)

    return over_environments(agent, environments, of_one, environments.states)


def step(
    agent: Agent, environments: Environments, action: Int[Array, " e"], volumes_drawn: Float[Array, "e n"]
) -> Step:
    """Take one step in every environment.

    Args:
        agent: whose environments they are.
        environments: before the slot.
        action: the device visited in each.
        volumes_drawn: uniform numbers from which the task volumes are drawn.
    """
    over = partial(over_environments, agent, environments)
    volumes = over(lambda scenario, drawn: draw_volumes(scenario.params, drawn), volumes_drawn)
    after, reward, outcome = over(advance, environments.states, action, volumes)
    truncated = over(is_truncated, after, outcome)
    return Step(after, reward, (outcome.cause != Cause.NONE) | truncated, truncated)


def start_ended(
    agent: Agent, environments: Environments, ended: Bool[Array, " e"], after: State, key: PRNGKeyArray
) -> Environments:
    """Start new episodes where one has ended, in newly drawn scenarios if the agent has a distribution."""
    if isinstance(agent.scenario, Scenario):
        states = jax.vmap(auto_reset, (0, None, 0, 0))(ended, agent.scenario, environments.states, after)
        return Environments(states, None)
    scenarios = jax.vmap(partial(sample_scenario, agent.scenario))(jax.random.split(key, ended.shape[0]))
    states = jax.vmap(initial_state)(scenarios.params, scenarios.layout)

    def select(new: Array, old: Array) -> Array:
        return jnp.where(ended.reshape(ended.shape + (1,) * (jnp.ndim(old) - 1)), new, old)

    return Environments(jax.tree.map(select, states, after), jax.tree.map(select, scenarios, environments.scenarios))

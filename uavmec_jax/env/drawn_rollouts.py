"""Episodes in scenarios that are drawn from a distribution, each with the volumes of its own draw."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PRNGKeyArray

from uavmec_jax.env.checks import check_range
from uavmec_jax.env.generator import ScenarioDistribution, scenario_from_draw
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.rewards import check_reward
from uavmec_jax.env.rollout import Episode, Policy, rollout, rollouts
from uavmec_jax.env.scenario import Scenario


def rollout_draws(policy: Policy, scenario: Scenario | ScenarioDistribution, keys: Key[Array, " D"]) -> Episode:
    """Play one episode per key; the result's leaves are ``[D, ...]``.

    Args:
        policy: chooses each UAV's place in each slot.
        scenario: a scenario, or a distribution from which every key draws its own scenario.
        keys: draw the task volumes, and the scenarios if there is a distribution.

    Raises:
        ArgumentError: a value of the scenario or the distribution is out of range, or there are no keys; one line.
    """
    if isinstance(scenario, Scenario):
        check_reward(scenario.reward)
        return rollouts(policy, scenario.params, scenario.layout, keys)
    check_range("the number of keys", len(keys), ge=1, whole=True)
    return jax.vmap(lambda key: _rollout_draw(policy, scenario, key)[1])(keys)


def priced_lifetimes(policy: Policy, distribution: ScenarioDistribution, keys: Key[Array, " D"]) -> Float[Array, " D"]:
    """Return each episode's lifetime in slots, less the price of its first failure; every key draws its own scenario."""

    def priced_lifetime(key: PRNGKeyArray) -> Float[Array, ""]:
        layout, episode = _rollout_draw(policy, distribution, key)
        return episode.length.astype(jnp.float32) - jnp.sum(episode.first_failure * layout.failure_price(0.0))

    return jax.vmap(priced_lifetime)(keys)


def _rollout_draw(policy: Policy, distribution: ScenarioDistribution, key: PRNGKeyArray) -> tuple[Layout, Episode]:
    """Draw a scenario, play an episode in it, and return its layout and the episode."""
    scenario = scenario_from_draw(distribution, key)
    return scenario.layout, rollout(policy, scenario.params, scenario.layout, key)

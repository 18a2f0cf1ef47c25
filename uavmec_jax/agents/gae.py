"""The parts of a policy gradient: sampled actions, their log-probabilities, and generalised advantage estimation (GAE)."""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from uavmec_jax.env.types import Scalar


def sample_action(logits: Float[Array, "e n"], uniform: Float[Array, " e"]) -> Int[Array, " e"]:
    """Sample one action from the softmax of each row of ``logits``, by inversion.

    Args:
        logits: unnormalised log-probabilities.
        uniform: one uniform random number in [0, 1) for each action.
    """
    mass = jnp.cumsum(jnp.exp(logits - jnp.max(logits, axis=-1, keepdims=True)), axis=-1)
    below = jnp.sum(mass <= uniform[:, None] * mass[:, -1:], axis=-1)
    return jnp.minimum(below, logits.shape[-1] - 1).astype(jnp.int32)


def generalized_advantages(
    reward: Float[Array, "t e"],
    value: Float[Array, "t e"],
    last_value: Float[Array, " e"],
    ended: Bool[Array, "t e"],
    gamma: Scalar,
    gae_lambda: Scalar,
) -> Float[Array, "t e"]:
    """Return generalised advantage estimates (Schulman et al., 2016, equation 16).

    Args:
        reward: reward of each slot.
        value: value of the state before each slot.
        last_value: value of the state after the last slot.
        ended: whether an episode ended with the slot.
        gamma: discount factor.
        gae_lambda: weight of longer estimates: 0 gives one-step advantages, 1 the discounted return minus the value.
    """
    chex.assert_equal_shape([reward, value, ended])

    def backward(later: tuple[Array, Array], slot: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], Array]:
        (advantage, next_value), (reward, value, ended) = later, slot
        continues = 1.0 - ended
        delta = reward + gamma * next_value * continues - value
        advantage = delta + gamma * gae_lambda * continues * advantage
        return (advantage, value), advantage

    return jax.lax.scan(backward, (jnp.zeros_like(last_value), last_value), (reward, value, ended), reverse=True)[1]


def log_prob_and_entropy(
    logits: Float[Array, "b n"], action: Int[Array, " b"]
) -> tuple[Float[Array, " b"], Float[Array, " b"]]:
    """Return the log-probability of each action and the entropy of each distribution."""
    log_probs = jax.nn.log_softmax(logits, axis=-1)
    log_prob = jnp.sum(log_probs * jax.nn.one_hot(action, logits.shape[-1]), axis=-1)
    return log_prob, -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)


def normalize(advantage: Float[Array, " b"], enabled: Scalar) -> Float[Array, " b"]:
    """Scale advantages to mean 0 and standard deviation 1 (ddof 1, plus 1e-8) if ``enabled``; a single one is kept."""
    if advantage.shape[0] < 2:
        return advantage
    scaled = (advantage - jnp.mean(advantage)) / (jnp.std(advantage, ddof=1) + 1e-8)
    return jnp.where(enabled, scaled, advantage)

"""Estimates that policy gradients are made of: drawn actions, their log-probabilities, generalised generalized_advantages."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def sample_action(scores: Float[Array, "e n"], uniform: Float[Array, " e"]) -> Int[Array, " e"]:
    """Actions ``[E]`` drawn from the softmax of ``scores``, each by one uniform number in [0, 1)."""
    mass = jnp.cumsum(jnp.exp(scores - jnp.max(scores, axis=-1, keepdims=True)), axis=-1)
    below = jnp.sum(mass <= uniform[:, None] * mass[:, -1:], axis=-1)
    return jnp.minimum(below, scores.shape[-1] - 1).astype(jnp.int32)


def generalized_advantages(
    reward: Float[Array, "t e"],
    value: Float[Array, "t e"],
    last_value: Float[Array, " e"],
    ended: Bool[Array, "t e"],
    gamma: Any,
    gae_lambda: Any,
) -> Float[Array, "t e"]:
    """Generalised advantage estimates (Schulman et al., 2016, equation 16).

    Args:
        reward: of each slot.
        value: of the state before each slot.
        last_value: of the states after the last slot.
        ended: whether an episode ended with the slot.
        gamma: discount.
        gae_lambda: lambda.
    """

    def back(later: tuple[Array, Array], slot: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], Array]:
        (advantage, next_value), (reward, value, ended) = later, slot
        goes_on = 1.0 - ended
        delta = reward + gamma * next_value * goes_on - value
        advantage = delta + gamma * gae_lambda * goes_on * advantage
        return (advantage, value), advantage

    return jax.lax.scan(back, (jnp.zeros_like(last_value), last_value), (reward, value, ended), reverse=True)[1]


def log_probability(scores: Float[Array, "b n"], action: Int[Array, " b"]) -> tuple[Array, Array]:
    """Log-probability ``[B]`` of each action, and the entropy ``[B]`` of each distribution."""
    logs = jax.nn.log_softmax(scores, axis=-1)
    taken = jnp.sum(logs * jax.nn.one_hot(action, scores.shape[-1]), axis=-1)
    return taken, -jnp.sum(jnp.exp(logs) * logs, axis=-1)


def normalized(advantage: Float[Array, " b"], normalize: Any) -> Float[Array, " b"]:
    """Advantages of mean zero and deviation one (ddof 1, plus 1e-8) where ``normalize``; a single one stays as it is."""
    if advantage.shape[0] < 2:
        return advantage
    scaled = (advantage - jnp.mean(advantage)) / (jnp.std(advantage, ddof=1) + 1e-8)
    return jnp.where(normalize, scaled, advantage)

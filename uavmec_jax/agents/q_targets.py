"""The targets of Q-learning: lambda-returns with Watkins' cut, and the gap between the best action and the others."""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from uavmec_jax.env.types import Scalar


def values_of(q_values: Float[Array, "*b n"], action: Int[Array, "*b"]) -> Float[Array, "*b"]:
    """Return the Q-values of the given actions."""
    return jnp.sum(q_values * jax.nn.one_hot(action, q_values.shape[-1]), axis=-1)


def lambda_returns(
    reward: Float[Array, "t e"],
    value: Float[Array, "t e"],
    last_value: Float[Array, " e"],
    ended: Bool[Array, "t e"],
    greedy: Bool[Array, "t e"],
    gamma: Scalar,
    q_lambda: Scalar,
) -> Float[Array, "t e"]:
    """Return the lambda-returns of Q-learning: cut (Watkins, 1989) or not (Peng and Williams, 1996; Gallici et al., 2025).

    Args:
        reward: reward of each slot.
        value: value of the state before each slot, the highest of its Q-values.
        last_value: value of the state after the last slot.
        ended: whether an episode ended with the slot.
        greedy: whether the return may go on through the slot's action; with Watkins' cut, whether it was the greedy one.
        gamma: discount factor.
        q_lambda: weight of longer returns: 0 gives one-step targets.
    """
    chex.assert_equal_shape([reward, value, ended, greedy])

    def backward(later: tuple[Array, Array], slot: tuple[Array, ...]) -> tuple[tuple[Array, Array], Array]:
        (longer, next_value), (reward, value, ended, greedy) = later, slot
        target = reward + gamma * (1.0 - ended) * (next_value + q_lambda * (longer - next_value))
        return (jnp.where(greedy, target, value), value), target

    return jax.lax.scan(backward, (last_value, last_value), (reward, value, ended, greedy), reverse=True)[1]


def widen_gap(
    target: Float[Array, "*b"], q_values: Float[Array, "*b n"], action: Int[Array, "*b"], gap: Scalar
) -> Float[Array, "*b"]:
    """Return targets from which the action's disadvantage is subtracted (advantage learning).

    That widens the gap between the values of the best action and of the others, which then survives the errors of the
    approximation (Bellemare et al., 2016, equation 7).

    Args:
        target: of the Q-values.
        q_values: of the state.
        action: what was done.
        gap: share of ``max Q(s, .) - Q(s, a)`` that is subtracted, in [0, 1).
    """
    return target - gap * (jnp.max(q_values, axis=-1) - values_of(q_values, action))

"""Gradient clipping with Adam or RMSprop in one pass, exactly as in PyTorch, as Optax transformations."""

import math
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from uavmec_jax.agents.networks import Weights
from uavmec_jax.env.types import Scalar

MAX_LEARNING_RATE = 1e32
"""Largest learning rate with which an agent is trained; beyond it, the agent counts as diverged.

Adam moves a weight by at most ``(1 - b1) / sqrt(1 - b2) < 3.2`` learning rates, RMSprop by at most
``1 / sqrt(1 - decay) = 10``. Up to this bound, finite gradients therefore keep every weight finite for 10**5 million
updates, and the weights need no check of their own.
"""

_B1, _B2 = 0.9, 0.999


def _clip(gradient: Weights, norm: Float[Array, ""], max_norm: Scalar, enabled: Bool[Array, ""]) -> Weights:
    """Scale a gradient by ``min(max_norm / (norm + 1e-6), 1)`` as ``torch.nn.utils.clip_grad_norm_``; 0 if disabled."""
    factor = jnp.minimum(max_norm / (norm + 1e-6), 1.0)
    return jax.tree.map(lambda g: jnp.where(enabled, g * factor, 0.0), gradient)


def clipped_adam(eps: float = 1e-8) -> optax.GradientTransformationExtraArgs:
    """Return global-norm clipping followed by Adam (b1 0.9, b2 0.999); every other setting is an argument of ``update``.

    ``update`` takes ``learning_rate``, ``max_norm``, the gradient's ``norm``, ``count`` (this update's number, from 1) and
    ``enabled``, all of them traced. Where ``enabled`` is False, the gradient counts as zero, whatever it holds, and the
    weights do not move.
    """

    def init(params: Weights) -> optax.ScaleByAdamState:
        zeros = jax.tree.map(jnp.zeros_like, params)
        return optax.ScaleByAdamState(count=jnp.zeros((), jnp.int32), mu=zeros, nu=jax.tree.map(jnp.copy, zeros))

    def update(
        updates: Weights,
        state: optax.ScaleByAdamState,
        params: Weights = None,
        *,
        learning_rate: Scalar,
        max_norm: Scalar,
        norm: Float[Array, ""],
        count: Int[Array, ""],
        enabled: Bool[Array, ""],
        **_: Any,
    ) -> tuple[Weights, optax.ScaleByAdamState]:
        del params
        gradient = _clip(updates, norm, max_norm, enabled)
        mu = jax.tree.map(lambda m, g: _B1 * m + (1 - _B1) * g, state.mu, gradient)
        nu = jax.tree.map(lambda v, g: _B2 * v + (1 - _B2) * g * g, state.nu, gradient)
        # Without the barrier XLA computes both moments again inside the weights' loop and copies the old ones.
        mu, nu = jax.lax.optimization_barrier((mu, nu))
        t = jnp.maximum(count, 1).astype(jnp.float32)
        # 1 - b**t as -expm1(t log b): in 32 bits the plain difference is off by 1e-5 in the first updates.
        step_size = jnp.where(enabled, learning_rate / -jnp.expm1(t * math.log(_B1)), 0.0)
        scale = jax.lax.rsqrt(-jnp.expm1(t * math.log(_B2)))
        steps = jax.tree.map(lambda m, v: -step_size * m / (jnp.sqrt(v) * scale + eps), mu, nu)
        return steps, optax.ScaleByAdamState(count=count, mu=mu, nu=nu)

    return optax.GradientTransformationExtraArgs(init, update)


def clipped_rmsprop(decay: float = 0.99, eps: float = 1e-5) -> optax.GradientTransformationExtraArgs:
    """Return global-norm clipping followed by PyTorch's RMSprop: average from zero, eps outside the root, no momentum.

    The arguments of ``update`` are those of :func:`clipped_adam`; ``count`` is not needed.
    """

    def init(params: Weights) -> optax.ScaleByRmsState:
        return optax.ScaleByRmsState(nu=jax.tree.map(jnp.zeros_like, params))

    def update(
        updates: Weights,
        state: optax.ScaleByRmsState,
        params: Weights = None,
        *,
        learning_rate: Scalar,
        max_norm: Scalar,
        norm: Float[Array, ""],
        enabled: Bool[Array, ""],
        **_: Any,
    ) -> tuple[Weights, optax.ScaleByRmsState]:
        del params
        gradient = _clip(updates, norm, max_norm, enabled)
        nu = jax.tree.map(lambda v, g: decay * v + (1 - decay) * g * g, state.nu, gradient)
        nu = jax.lax.optimization_barrier(nu)  # as in Adam
        step_size = jnp.where(enabled, learning_rate, 0.0)
        steps = jax.tree.map(lambda g, v: -step_size * g / (jnp.sqrt(v) + eps), gradient, nu)
        return steps, optax.ScaleByRmsState(nu=nu)

    return optax.GradientTransformationExtraArgs(init, update)


def linear_decay(initial: Scalar, final_share: Scalar, progress: Scalar) -> Scalar:
    """Return a value that falls linearly from ``initial``, at progress 0, to ``final_share`` of it, at progress 1."""
    return initial * (1.0 - progress * (1.0 - final_share))


@struct.dataclass
class TrainState:
    """The part of an agent's state that gradient steps change.

    Attributes:
        weights: parameters of the network.
        opt_state: the optimiser's state.
        diverged_at: environment step at which the agent was frozen, int32; -1 if it has not diverged.
    """

    weights: Weights
    opt_state: optax.OptState
    diverged_at: Int[Array, "*batch"]


def apply_gradients(
    optimizer: optax.GradientTransformationExtraArgs,
    train_state: TrainState,
    loss: Float[Array, ""],
    gradient: Weights,
    *,
    learning_rate: Scalar,
    max_norm: Scalar,
    count: int | Int[Array, ""],
    steps_done: int | Int[Array, ""],
    learning: Bool[ArrayLike, ""] = True,
) -> TrainState:
    """Make one gradient step, unless the agent is not ``learning`` yet or has diverged.

    A loss or gradient that is not finite, or a learning rate beyond :data:`MAX_LEARNING_RATE`, freezes the agent with its
    weights as they are, which are finite.

    Args:
        optimizer: :func:`clipped_adam` or :func:`clipped_rmsprop`.
        train_state: weights and optimiser state before the step.
        loss: value of the loss.
        gradient: gradient of the loss, the structure and shapes of the weights.
        learning_rate: of this step.
        max_norm: largest global norm of the gradient; a longer one is scaled down to it.
        count: number of this gradient step, from 1.
        steps_done: environment steps of the agent so far.
        learning: whether the warm-up is over.
    """
    chex.assert_trees_all_equal_shapes_and_dtypes(train_state.weights, gradient)
    norm = optax.tree.norm(gradient)
    is_finite = jnp.isfinite(loss) & jnp.isfinite(norm) & (jnp.abs(learning_rate) <= MAX_LEARNING_RATE)
    frozen = (train_state.diverged_at >= 0) | (learning & ~is_finite)
    steps, opt_state = optimizer.update(
        gradient,
        train_state.opt_state,
        learning_rate=learning_rate,
        max_norm=max_norm,
        norm=norm,
        count=count,
        enabled=learning & ~frozen,
    )
    return TrainState(
        weights=optax.apply_updates(train_state.weights, steps),
        opt_state=opt_state,
        diverged_at=jnp.where(frozen & (train_state.diverged_at < 0), steps_done, train_state.diverged_at),
    )

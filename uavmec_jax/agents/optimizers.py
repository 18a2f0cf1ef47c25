"""Gradient clipping with Adam or RMSprop in one pass, to the letter of PyTorch's, as Optax transformations."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float

MAX_LEARNING_RATE = 1e32
"""Adam moves a weight by at most ``(1 - b1) / sqrt(1 - b2) < 3.2`` learning rates. With a learning rate up to this
bound, finite gradients therefore keep every weight finite for 10**5 million updates, without looking at the weights. (RMSprop
moves one by at most ``1 / sqrt(1 - decay) = 10`` of them.)"""

_B1, _B2 = 0.9, 0.999


def global_norm(gradients: Any) -> Float[Array, ""]:
    """Euclidean norm over all leaves."""
    return jnp.sqrt(sum(jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(gradients)))


def _clipped(gradients: Any, norm: Float[Array, ""], max_norm: Any, enabled: Bool[Array, ""]) -> Any:
    """Gradients times ``min(max_norm / (norm + 1e-6), 1)`` (``torch.nn.utils.clip_grad_norm_``), or zero."""
    factor = jnp.minimum(max_norm / (norm + 1e-6), 1.0)
    return jax.tree.map(lambda g: jnp.where(enabled, g * factor, 0.0), gradients)


def clipped_adam(eps: float = 1e-8) -> optax.GradientTransformationExtraArgs:
    """Global-norm clipping, then Adam (b1 0.9, b2 0.999), every other setting a traced argument of ``update``.

    ``update`` takes ``learning_rate``, ``max_norm``, the gradient's ``norm``, ``count`` (this update's number, from 1)
    and ``enabled``; where ``enabled`` is False the gradient counts as zero, whatever it holds, and the weights do not
    move.
    """

    def init(params: Any) -> optax.ScaleByAdamState:
        zeros = jax.tree.map(jnp.zeros_like, params)
        return optax.ScaleByAdamState(count=jnp.zeros((), jnp.int32), mu=zeros, nu=jax.tree.map(jnp.copy, zeros))

    def update(
        updates: Any,
        state: optax.ScaleByAdamState,
        params: Any = None,
        *,
        learning_rate: Any,
        max_norm: Any,
        norm: Float[Array, ""],
        count: Any,
        enabled: Bool[Array, ""],
        **_: Any,
    ) -> tuple[Any, optax.ScaleByAdamState]:
        del params
        gradients = _clipped(updates, norm, max_norm, enabled)
        mu = jax.tree.map(lambda m, g: _B1 * m + (1 - _B1) * g, state.mu, gradients)
        nu = jax.tree.map(lambda v, g: _B2 * v + (1 - _B2) * g * g, state.nu, gradients)
        # Without the barrier XLA computes both opt_state a second time inside the weights' loop, and copies the old ones.
        mu, nu = jax.lax.optimization_barrier((mu, nu))
        updates_made = jnp.maximum(count, 1).astype(jnp.float32)
        # 1 - b**t as -expm1(t log b): in 32 bits the plain difference is off by 1e-5 for the first updates.
        step_size = jnp.where(enabled, learning_rate / -jnp.expm1(updates_made * math.log(_B1)), 0.0)
        scale = jax.lax.rsqrt(-jnp.expm1(updates_made * math.log(_B2)))
        steps = jax.tree.map(lambda m, v: -step_size * m / (jnp.sqrt(v) * scale + eps), mu, nu)
        return steps, optax.ScaleByAdamState(count=count, mu=mu, nu=nu)

    return optax.GradientTransformationExtraArgs(init, update)


def clipped_rmsprop(decay: float = 0.99, eps: float = 1e-5) -> optax.GradientTransformationExtraArgs:
    """Global-norm clipping, then RMSprop as PyTorch has it (average from zero, eps outside the root, no momentum).

    The arguments of ``update`` are those of :func:`clipped_adam`; ``count`` is not needed.
    """

    def init(params: Any) -> optax.ScaleByRmsState:
        return optax.ScaleByRmsState(nu=jax.tree.map(jnp.zeros_like, params))

    def update(
        updates: Any,
        state: optax.ScaleByRmsState,
        params: Any = None,
        *,
        learning_rate: Any,
        max_norm: Any,
        norm: Float[Array, ""],
        enabled: Bool[Array, ""],
        **_: Any,
    ) -> tuple[Any, optax.ScaleByRmsState]:
        del params
        gradients = _clipped(updates, norm, max_norm, enabled)
        nu = jax.tree.map(lambda v, g: decay * v + (1 - decay) * g * g, state.nu, gradients)
        nu = jax.lax.optimization_barrier(nu)  # as in Adam
        step_size = jnp.where(enabled, learning_rate, 0.0)
        steps = jax.tree.map(lambda g, v: -step_size * g / (jnp.sqrt(v) + eps), gradients, nu)
        return steps, optax.ScaleByRmsState(nu=nu)

    return optax.GradientTransformationExtraArgs(init, update)


@struct.dataclass
class TrainState:
    """The part of a learner's state that a gradient step moves.

    Attributes:
        weights: of the network.
        opt_state: the optimiser's state.
        diverged_at: int32, environment step at which the agent was frozen, -1 while it is sound.
    """

    weights: Any
    opt_state: Any
    diverged_at: Any


def apply_gradients(
    optimizer: optax.GradientTransformationExtraArgs,
    train_state: TrainState,
    loss: Float[Array, ""],
    gradient: Any,
    *,
    learning_rate: Any,
    max_norm: Any,
    count: Any,
    steps_done: Any,
    learning: Any = True,
) -> TrainState:
    """One gradient step, unless the agent is not ``learning`` yet or has diverged.

    A loss or gradient that is not finite, or a learning rate beyond :data:`MAX_LEARNING_RATE`, freezes the agent with
    the finite weights it has; see there why nothing else needs to be looked at.
    """
    norm = global_norm(gradient)
    sound = jnp.isfinite(loss) & jnp.isfinite(norm) & (jnp.abs(learning_rate) <= MAX_LEARNING_RATE)
    frozen = (train_state.diverged_at >= 0) | (learning & ~sound)
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

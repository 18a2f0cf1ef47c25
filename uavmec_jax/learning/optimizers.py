"""Gradient clipping and Adam in one pass, to the letter of PyTorch's, as an Optax transformation."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

MAX_LEARNING_RATE = 1e32
"""Adam moves a weight by at most ``(1 - b1) / sqrt(1 - b2) < 3.2`` learning rates. With a learning rate up to this
bound, finite gradients therefore keep every weight finite for 10**5 million updates, without looking at the weights."""

_B1, _B2, _EPS = 0.9, 0.999, 1e-8


def global_norm(gradients: Any) -> Float[Array, ""]:
    """Euclidean norm over all leaves."""
    return jnp.sqrt(sum(jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(gradients)))


def clipped_adam() -> optax.GradientTransformationExtraArgs:
    """Global-norm clipping, then Adam (b1 0.9, b2 0.999, eps 1e-8), every setting a traced argument of ``update``.

    Clipping multiplies by ``min(max_norm / (norm + 1e-6), 1)`` (``torch.nn.utils.clip_grad_norm_``). ``update`` takes
    ``learning_rate``, ``max_norm``, the gradient's ``norm``, ``count`` (this update's number, from 1) and ``enabled``;
    where ``enabled`` is False the gradient counts as zero, whatever it holds, and the weights do not move.
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
        factor = jnp.minimum(max_norm / (norm + 1e-6), 1.0)
        gradients = jax.tree.map(lambda g: jnp.where(enabled, g * factor, 0.0), updates)
        mu = jax.tree.map(lambda m, g: _B1 * m + (1 - _B1) * g, state.mu, gradients)
        nu = jax.tree.map(lambda v, g: _B2 * v + (1 - _B2) * g * g, state.nu, gradients)
        # Without the barrier XLA computes both moments a second time inside the weights' loop, and copies the old ones.
        mu, nu = jax.lax.optimization_barrier((mu, nu))
        updates_made = jnp.maximum(count, 1).astype(jnp.float32)
        # 1 - b**t as -expm1(t log b): in 32 bits the plain difference is off by 1e-5 for the first updates.
        step_size = jnp.where(enabled, learning_rate / -jnp.expm1(updates_made * math.log(_B1)), 0.0)
        scale = jax.lax.rsqrt(-jnp.expm1(updates_made * math.log(_B2)))
        steps = jax.tree.map(lambda m, v: -step_size * m / (jnp.sqrt(v) * scale + _EPS), mu, nu)
        return steps, optax.ScaleByAdamState(count=count, mu=mu, nu=nu)

    return optax.GradientTransformationExtraArgs(init, update)

"""Clipping and Adam against NumPy in double precision."""

import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from uavmec_jax.agents.optimizers import clipped_adam


def numpy_adam(weights, gradients, learning_rate, max_norm):
    """PyTorch's clip_grad_norm_ and Adam, in float64."""
    m, v = np.zeros_like(weights), np.zeros_like(weights)
    for count, g in enumerate(gradients, start=1):
        g = g * min(max_norm / (np.linalg.norm(g) + 1e-6), 1.0)
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        weights = weights - learning_rate / (1 - 0.9**count) * m / (np.sqrt(v) / np.sqrt(1 - 0.999**count) + 1e-8)
    return weights


def adam(weights, gradients, learning_rate, max_norm, enabled=True, jit=lambda function: function):
    params = {"w": jnp.asarray(weights, jnp.float32)}
    state = clipped_adam().init(params)

    @jit
    def step(params, state, gradient, count):
        updates, state = clipped_adam().update(
            gradient, state, learning_rate=learning_rate, max_norm=max_norm, norm=optax.tree.norm(gradient),
            count=count, enabled=jnp.asarray(enabled),
        )  # fmt: skip
        return optax.apply_updates(params, updates), state

    for count, gradient in enumerate(gradients, start=1):
        params, state = step(params, state, {"w": jnp.asarray(gradient, jnp.float32)}, jnp.int32(count))
    return params["w"]


@pytest.mark.parametrize("max_norm", [0.5, 10.0])
@pytest.mark.parametrize("updates", [1, 10, 300])
def test_against_numpy(jit, max_norm, updates):
    rng = np.random.default_rng(0)
    weights, gradients = rng.normal(size=20), rng.normal(size=(updates, 20))
    expected = numpy_adam(weights, gradients, 0.0071, max_norm)
    assert_allclose(adam(weights, gradients, 0.0071, max_norm, jit=jit), expected, rtol=2e-5, atol=1e-6)


def test_disabled_update_moves_nothing_whatever_the_gradient():
    weights = np.ones(3, np.float32)
    assert_array_equal(adam(weights, [[np.nan, np.inf, 1.0]] * 3, 0.1, 10.0, enabled=False), weights)

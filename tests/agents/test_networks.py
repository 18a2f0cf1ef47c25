"""Initial weights and the backward pass of the dense layers."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from uavmec_jax.agents.networks import QNetwork, matmul


def test_shapes_and_initial_distribution():
    weights = QNetwork(12).init(jax.random.key(0), jnp.zeros((1, 24)))["params"]
    shapes = {name: layer["kernel"].shape for name, layer in weights.items()}
    assert shapes == {"TorchDense_0": (24, 64), "TorchDense_1": (64, 64), "TorchDense_2": (64, 12)}
    for layer in weights.values():
        bound = layer["kernel"].shape[0] ** -0.5
        for leaf in layer.values():
            scaled = np.asarray(leaf).ravel() / bound
            assert np.abs(scaled).max() <= 1
            assert stats.kstest(scaled, stats.uniform(-1, 2).cdf).pvalue > 1e-3


def test_forward_is_three_dense_layers_with_relu():
    network = QNetwork(3, hidden=(4,))
    x = jax.random.normal(jax.random.key(1), (5, 6))
    weights = network.init(jax.random.key(0), x)
    hidden, head = (weights["params"][f"TorchDense_{i}"] for i in range(2))
    by_hand = np.maximum(x @ hidden["kernel"] + hidden["bias"], 0) @ head["kernel"] + head["bias"]
    assert_allclose(network.apply(weights, x), by_hand, rtol=1e-5)
    assert_allclose(network.apply(weights, x[2]), by_hand[2], rtol=1e-5, atol=1e-6)


def test_matmul_has_the_gradient_of_the_plain_product(jit):
    x, w = jax.random.normal(jax.random.key(0), (16, 24)), jax.random.normal(jax.random.key(1), (24, 8))
    loss = lambda product: lambda x, w: jnp.sum(jnp.sin(product(x, w)))  # noqa: E731
    ours, plain = (jit(jax.grad(loss(product), argnums=(0, 1)))(x, w) for product in (matmul, jnp.matmul))
    chex.assert_trees_all_close(ours, plain, rtol=1e-5, atol=1e-5)
    assert_array_equal(matmul(x, w), x @ w)

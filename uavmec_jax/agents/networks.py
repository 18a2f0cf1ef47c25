"""Networks: small dense stacks, initialised as Stable-Baselines3 does."""

import math
from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import traverse_util
from jaxtyping import Array, Float, Int, PRNGKeyArray

from uavmec_jax.env.products import product
from uavmec_jax.env.types import Scalar

Weights = Any
"""Parameters of a network, or their gradient: nested dictionaries of arrays, leaves ``[*batch, ...]``."""


_NORM_EPS = 1e-6
"""Added to the variance in a layer normalisation."""


@jax.custom_vjp
def matmul(x: Float[Array, "... i"], w: Float[Array, "i o"]) -> Float[Array, "... o"]:
    """Return ``x @ w``. On a CPU the backward pass transposes its operands in memory first.

    There, XLA's matrix products are two to three times slower on the memory layout that plain autodiff produces. The
    barrier keeps XLA from optimising the transposed copies away. The result is that of ``x @ w``, to the bit.
    """
    return product(x, w)


def _matmul_forward(x: Array, w: Array) -> tuple[Array, tuple[Array, Array]]:
    return product(x, w), (x, w)


def _matmul_backward(residuals: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, w = residuals
    transposed = (jnp.swapaxes(x, -1, -2), w.T)
    x_t, w_t = jax.lax.optimization_barrier(transposed) if jax.default_backend() == "cpu" else transposed
    return product(gradient, w_t), product(x_t, gradient)


matmul.defvjp(_matmul_forward, _matmul_backward)


class TorchDense(nn.Module):
    """Dense layer with weights and biases uniform in ``+-1/sqrt(fan_in)``, PyTorch's default for ``Linear``."""

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "... i"]) -> Float[Array, "... o"]:
        """Apply the layer to ``[i]`` or ``[batch, i]``."""
        fan_in = x.shape[-1]

        def uniform(key: PRNGKeyArray, shape: tuple[int, ...]) -> Array:
            bound = fan_in**-0.5
            return jax.random.uniform(key, shape, jnp.float32, -bound, bound)

        kernel = self.param("kernel", uniform, (fan_in, self.features))
        bias = self.param("bias", uniform, (self.features,))
        return (matmul(x, kernel) if x.ndim > 1 else product(x, kernel)) + bias


def orthogonal(key: PRNGKeyArray, shape: tuple[int, int], gain: float) -> Float[Array, "i o"]:
    """Draw a uniformly random matrix with orthonormal columns (rows, if there are fewer), times ``gain``.

    It is made by Gram-Schmidt on Gaussian columns; each column is orthogonalised twice, which leaves only rounding
    errors. LAPACK's QR is avoided: in jaxlib 0.10 it deadlocks when several CPU devices call it at the same time.
    """
    rows, columns = max(shape), min(shape)
    gaussian = jax.random.normal(key, (rows, columns))

    def add_column(k: Int[Array, ""], basis: Float[Array, "r c"]) -> Float[Array, "r c"]:
        column = gaussian[:, k]
        for _ in range(2):
            column = column - product(basis, product(column, basis))
        return basis.at[:, k].set(column / jnp.linalg.norm(column))

    basis = gain * jax.lax.fori_loop(0, columns, add_column, jnp.zeros((rows, columns)))
    return basis if shape[0] >= shape[1] else basis.T


class OrthogonalDense(nn.Module):
    """Dense layer with orthogonal weights times ``gain`` and zero biases."""

    features: int
    gain: float

    @nn.compact
    def __call__(self, x: Float[Array, "b i"]) -> Float[Array, "b o"]:
        """Apply the layer to ``[batch, i]``."""
        kernel = self.param("kernel", orthogonal, (x.shape[-1], self.features), self.gain)
        return matmul(x, kernel) + self.param("bias", nn.initializers.zeros, (self.features,))


@jax.custom_vjp
def normalize_layer(
    x: Float[Array, "... f"], scale: Float[Array, " f"], bias: Float[Array, " f"]
) -> Float[Array, "... f"]:
    """Normalise each row to mean 0 and variance 1, then scale and shift it (Ba et al., 2016, equation 3).

    The gradient is written out, which takes a third fewer passes over the rows than that of automatic differentiation.
    """
    return _normalize_forward(x, scale, bias)[0]


def _normalize_forward(x: Array, scale: Array, bias: Array) -> tuple[Array, tuple[Array, Array, Array]]:
    centered = x - jnp.mean(x, axis=-1, keepdims=True)
    inverse = jax.lax.rsqrt(jnp.mean(jnp.square(centered), axis=-1, keepdims=True) + _NORM_EPS)
    normalized = centered * inverse
    return normalized * scale + bias, (normalized, inverse, scale)


def _normalize_backward(residuals: tuple[Array, Array, Array], gradient: Array) -> tuple[Array, Array, Array]:
    normalized, inverse, scale = residuals
    rows = tuple(range(gradient.ndim - 1))
    scaled = gradient * scale
    along = jnp.mean(scaled * normalized, axis=-1, keepdims=True)
    dx = inverse * (scaled - jnp.mean(scaled, axis=-1, keepdims=True) - normalized * along)
    return dx, jnp.sum(gradient * normalized, axis=rows), jnp.sum(gradient, axis=rows)


normalize_layer.defvjp(_normalize_forward, _normalize_backward)


class LayerNorm(nn.Module):
    """Layer normalisation with a learned scale and shift."""

    @nn.compact
    def __call__(self, x: Float[Array, "... f"]) -> Float[Array, "... f"]:
        """Apply the layer to ``[..., f]``."""
        scale = self.param("scale", nn.initializers.ones, (x.shape[-1],))
        return normalize_layer(x, scale, self.param("bias", nn.initializers.zeros, (x.shape[-1],)))


class QNetwork(nn.Module):
    """The paper's Q-network: ReLU layers, then one value per action.

    Attributes:
        n_actions: number of actions, one per device.
        hidden: widths of the hidden layers; (64, 64) in the paper.
        dueling: whether the head is a state value plus advantages of mean zero (Wang et al., 2016, equation 9).
        layer_norm: whether each hidden layer is normalised before its ReLU (Ba et al., 2016).
    """

    n_actions: int
    hidden: tuple[int, ...] = (64, 64)
    dueling: bool = False
    layer_norm: bool = False

    @nn.compact
    def __call__(self, observation: Float[Array, "... two_n"]) -> Float[Array, "... n"]:
        """Return Q-values ``[..., n]`` of observations ``[..., 2n]``. Gradients allow at most one batch axis."""
        x = observation
        for width in self.hidden:
            x = TorchDense(width)(x)
            x = nn.relu(LayerNorm()(x) if self.layer_norm else x)
        values = TorchDense(self.n_actions)(x)
        if self.dueling:
            values = TorchDense(1)(x) + values - jnp.mean(values, axis=-1, keepdims=True)
        return values


class MLP(nn.Module):
    """Tanh layers with orthogonal weights (gain sqrt 2), then a linear layer whose gain is ``head_gain``."""

    features: int
    hidden: tuple[int, ...]
    head_gain: float

    @nn.compact
    def __call__(self, x: Float[Array, "b i"]) -> Float[Array, "b o"]:
        """Apply the stack to ``[batch, i]``."""
        for width in self.hidden:
            x = nn.tanh(OrthogonalDense(width, math.sqrt(2.0))(x))
        return OrthogonalDense(self.features, self.head_gain)(x)


class ActorCritic(nn.Module):
    """Separate networks for policy and value, as in Stable-Baselines3's PPO and A2C.

    Attributes:
        n_actions: number of actions, one per device.
        hidden: widths of the hidden layers of each network.
    """

    n_actions: int
    hidden: tuple[int, ...] = (64, 64)

    def setup(self) -> None:
        """Declare the two networks."""
        self.policy = MLP(self.n_actions, self.hidden, head_gain=0.01)
        self.critic = MLP(1, self.hidden, head_gain=1.0)

    def logits(self, observation: Float[Array, "b two_n"]) -> Float[Array, "b n"]:
        """Return the unnormalised log-probabilities of the actions."""
        return self.policy(observation)

    def value(self, observation: Float[Array, "b two_n"]) -> Float[Array, " b"]:
        """Return the state values."""
        return self.critic(observation)[:, 0]

    def __call__(self, observation: Float[Array, "b two_n"]) -> tuple[Float[Array, "b n"], Float[Array, " b"]]:
        """Return logits and values."""
        return self.logits(observation), self.value(observation)


def count_weights(network: nn.Module, obs_size: int) -> int:
    """Count the weights of a network without allocating them."""
    return sum(math.prod(shape) for shape in weight_shapes(network, obs_size).values())


@lru_cache(maxsize=64)
def weight_shapes(network: nn.Module, obs_size: int) -> Mapping[str, tuple[int, ...]]:
    """Return the shapes of a network's weights by name, ``params/Dense_0/kernel``; nothing is allocated."""
    weights: Weights = jax.eval_shape(network.init, jax.random.key(0), jnp.zeros((1, obs_size)))
    leaves = traverse_util.flatten_dict(weights, sep="/")
    return MappingProxyType({name: leaf.shape for name, leaf in leaves.items()})


def scale_ages(observation: Float[Array, "*b two_n"], age_scale: Scalar) -> Float[Array, "*b two_n"]:
    """Multiply the ages, the second half of the paper's observation, by ``age_scale``."""
    size = observation.shape[-1]
    return observation * jnp.where(jnp.arange(size) < size // 2, 1.0, age_scale)

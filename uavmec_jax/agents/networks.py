"""Networks: small dense stacks, initialised as Stable-Baselines3 does."""

import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from uavmec_jax.env.fixed_point import order_independent_sum
from uavmec_jax.env.products import product
from uavmec_jax.env.types import Scalar

Weights = Any
"""Parameters of a network, or their gradient: nested dictionaries of arrays, leaves ``[*batch, ...]``."""


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


class QNetwork(nn.Module):
    """The paper's Q-network: ReLU layers, then one value per action.

    Attributes:
        n_actions: number of actions, one per device.
        hidden: widths of the hidden layers; (64, 64) in the paper.
        dueling: whether the head is a state value plus advantages of mean zero (Wang et al., 2016, equation 9).
    """

    n_actions: int
    hidden: tuple[int, ...] = (64, 64)
    dueling: bool = False

    @nn.compact
    def __call__(self, observation: Float[Array, "... two_n"]) -> Float[Array, "... n"]:
        """Return Q-values ``[..., n]`` of observations ``[..., 2n]``. Gradients allow at most one batch axis."""
        x = observation
        for width in self.hidden:
            x = nn.relu(TorchDense(width)(x))
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
    weights: Weights = jax.eval_shape(network.init, jax.random.key(0), jnp.zeros((1, obs_size)))
    return sum(leaf.size for leaf in jax.tree.leaves(weights))


def scale_ages(observation: Float[Array, "*b two_n"], age_scale: Scalar) -> Float[Array, "*b two_n"]:
    """Multiply the ages, the second half of the paper's observation, by ``age_scale``."""
    size = observation.shape[-1]
    return observation * jnp.where(jnp.arange(size) < size // 2, 1.0, age_scale)


@jax.custom_jvp
def sum_over_devices(x: Float[Array, "b n f"]) -> Float[Array, "b f"]:
    """Sum over the devices with :func:`order_independent_sum`; the gradient is that of a plain sum."""
    return order_independent_sum(x, axis=-2)


@sum_over_devices.defjvp
def _sum_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return sum_over_devices(*primals), jnp.sum(tangents[0], axis=-2)


class RowScore(nn.Module):
    """Dense layer with one output and orthogonal weights times ``gain``; its bits do not depend on the row's place.

    XLA's CPU kernels compute a matrix product with a single column differently in the last rows of a batch. A product and
    a sum over each row give the same bits everywhere.
    """

    gain: float

    @nn.compact
    def __call__(self, x: Float[Array, "*b i"]) -> Float[Array, "*b"]:
        """Apply the layer to ``[..., i]``."""
        kernel = self.param("kernel", orthogonal, (x.shape[-1], 1), self.gain)
        return jnp.sum(x * kernel[:, 0], axis=-1) + self.param("bias", nn.initializers.zeros, (1,))[0]


class EquivariantActorCritic(nn.Module):
    """An actor and a critic for any number of devices; permuting the devices permutes the logits, to the bit.

    An encoder embeds each device on its own. Means and maxima of the embeddings over the devices tell the policy head,
    which scores each device, about the other devices (Zaheer et al., 2017, Deep sets, theorem 2 and section 4). The names
    of the layers are those in the published weights; they also seed the initial weights.

    Attributes:
        n_features: features of a device; each row of an observation is these features and the device's mask.
        hidden: widths of the encoder's layers; the heads have the width of the last one.
    """

    n_features: int
    hidden: tuple[int, ...] = (64, 64)

    def setup(self) -> None:
        """Declare the layers."""
        gain, width = math.sqrt(2.0), self.hidden[-1]
        self.encoder = [OrthogonalDense(size, gain, name=f"looks_{k}") for k, size in enumerate(self.hidden)]
        self.policy_device = OrthogonalDense(width, gain, name="own")
        self.policy_pooled = OrthogonalDense(width, gain, name="others")
        self.policy_head = RowScore(0.01, name="score")
        self.value_hidden = OrthogonalDense(width, gain, name="appraise")
        self.value_head = RowScore(1.0, name="worth")

    def _encode(
        self, observation: Float[Array, "B obs_size"]
    ) -> tuple[Float[Array, "B n h"], Float[Array, "B two_h"], Bool[Array, "B n"]]:
        """Return the embedding of each device, the embeddings' means and maxima, and which entries are devices."""
        devices = observation.reshape(observation.shape[0], -1, self.n_features + 1)
        mask = devices[..., -1] > 0.5
        x = devices[..., :-1].reshape(-1, self.n_features)
        for layer in self.encoder:
            x = nn.relu(layer(x))
        x = x.reshape(*mask.shape, -1)
        present = jnp.where(mask[..., None], x, 0.0)  # relu is at least 0, so padding never is the maximum
        count = jnp.maximum(jnp.sum(mask, axis=-1, keepdims=True), 1)
        return x, jnp.concatenate([sum_over_devices(present) / count, jnp.max(present, axis=-2)], axis=-1), mask

    def _logits(
        self, x: Float[Array, "B n h"], pooled: Float[Array, "B two_h"], mask: Bool[Array, "B n"]
    ) -> Float[Array, "B n"]:
        device = self.policy_device(x.reshape(-1, x.shape[-1])).reshape(x.shape)
        x = nn.relu(device + self.policy_pooled(pooled)[:, None])
        return jnp.where(mask, self.policy_head(x), ABSENT_LOGIT)

    def _value(self, pooled: Float[Array, "B two_h"]) -> Float[Array, " B"]:
        return self.value_head(nn.relu(self.value_hidden(pooled)))

    def logits(self, observation: Float[Array, "B obs_size"]) -> Float[Array, "B n"]:
        """Return the unnormalised log-probabilities of the actions; :data:`ABSENT_LOGIT` where there is no device."""
        return self._logits(*self._encode(observation))

    def value(self, observation: Float[Array, "B obs_size"]) -> Float[Array, " B"]:
        """Return the state values."""
        return self._value(self._encode(observation)[1])

    def __call__(self, observation: Float[Array, "B obs_size"]) -> tuple[Float[Array, "B n"], Float[Array, " B"]]:
        """Return logits and values."""
        x, pooled, mask = self._encode(observation)
        return self._logits(x, pooled, mask), self._value(pooled)


ABSENT_LOGIT = -1e9
"""Logit of an action that is not a device."""

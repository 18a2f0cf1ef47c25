"""Networks of the learners: small dense stacks, initialised as Stable-Baselines3 initialises its own."""

import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from uavmec_jax.env.fixed_point import order_independent_sum


@jax.custom_vjp
def matmul(x: Float[Array, "... i"], w: Float[Array, "i o"]) -> Float[Array, "... o"]:
    """``x @ w`` whose backward pass transposes its operands in memory first.

    XLA's CPU products run two to three times slower on the layout that plain autodiff hands them; the barrier makes
    the transposed copy real. The numbers are those of ``x @ w``.
    """
    return x @ w


def _matmul_forward(x: Array, w: Array) -> tuple[Array, tuple[Array, Array]]:
    return x @ w, (x, w)


def _matmul_backward(residuals: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, w = residuals
    x_t, w_t = jax.lax.optimization_barrier((jnp.swapaxes(x, -1, -2), w.T))
    return gradient @ w_t, x_t @ gradient


matmul.defvjp(_matmul_forward, _matmul_backward)


class TorchDense(nn.Module):
    """Dense layer, weights and biases uniform in ``+-1/sqrt(fan_in)`` (PyTorch's default for ``Linear``)."""

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "... i"]) -> Float[Array, "... o"]:
        """Apply the layer to ``[i]`` or ``[batch, i]``."""
        fan_in = x.shape[-1]

        def uniform(key: Array, shape: tuple[int, ...]) -> Array:
            bound = fan_in**-0.5
            return jax.random.uniform(key, shape, jnp.float32, -bound, bound)

        kernel = self.param("kernel", uniform, (fan_in, self.features))
        bias = self.param("bias", uniform, (self.features,))
        return (matmul(x, kernel) if x.ndim > 1 else x @ kernel) + bias


def orthogonal(key: Array, shape: tuple[int, int], gain: float) -> Float[Array, "i o"]:
    """A uniformly random matrix with orthonormal columns (rows, if there are fewer), times ``gain``.

    Gram-Schmidt on Gaussian columns, each made orthogonal twice to be so to rounding. (Not LAPACK's QR: several of
    them at once on several CPU devices wait for each other for ever in jaxlib 0.10.)
    """
    rows, columns = max(shape), min(shape)
    gaussian = jax.random.normal(key, (rows, columns))

    def add_column(k: Any, basis: Array) -> Array:
        column = gaussian[:, k]
        for _ in range(2):
            column = column - basis @ (column @ basis)
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
        dueling: whether the head is a state value and generalized_advantages of mean zero (Wang et al., 2016, equation 9).
    """

    n_actions: int
    hidden: tuple[int, ...] = (64, 64)
    dueling: bool = False

    @nn.compact
    def __call__(self, observation: Float[Array, "... two_n"]) -> Float[Array, "... n"]:
        """Q-values ``[..., n]`` of observations ``[..., 2n]``; at most one batch axis where gradients are taken."""
        x = observation
        for width in self.hidden:
            x = nn.relu(TorchDense(width)(x))
        values = TorchDense(self.n_actions)(x)
        if self.dueling:
            values = TorchDense(1)(x) + values - jnp.mean(values, axis=-1, keepdims=True)
        return values


class MLP(nn.Module):
    """Tanh layers with orthogonal weights (gain sqrt 2), then a linear head."""

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
    """Separate networks for policy and value, as Stable-Baselines3's PPO and A2C have them.

    Attributes:
        n_actions: number of actions, one per device.
        hidden: widths of the hidden layers of each.
    """

    n_actions: int
    hidden: tuple[int, ...] = (64, 64)

    def setup(self) -> None:
        """Declare the two networks."""
        self.policy = MLP(self.n_actions, self.hidden, head_gain=0.01)
        self.critic = MLP(1, self.hidden, head_gain=1.0)

    def logits(self, observation: Float[Array, "b two_n"]) -> Float[Array, "b n"]:
        """Unnormalised log-probabilities ``[B, n]`` of the actions."""
        return self.policy(observation)

    def value(self, observation: Float[Array, "b two_n"]) -> Float[Array, " b"]:
        """State values ``[B]``."""
        return self.critic(observation)[:, 0]

    def __call__(self, observation: Float[Array, "b two_n"]) -> tuple[Array, Array]:
        """Logits and values."""
        return self.logits(observation), self.value(observation)


def count_weights(network: nn.Module, observation_size: int) -> int:
    """Number of weights of a network, without making them."""
    made: Any = jax.eval_shape(network.init, jax.random.key(0), jnp.zeros((1, observation_size)))
    return sum(leaf.size for leaf in jax.tree.leaves(made))


def scale_ages(observation: Float[Array, "*b two_n"], age_scale: Any) -> Float[Array, "*b two_n"]:
    """An observation with its ages, the second half, multiplied by ``age_scale``."""
    size = observation.shape[-1]
    return observation * jnp.where(jnp.arange(size) < size // 2, 1.0, age_scale)


@jax.custom_jvp
def sum_over_devices(x: Float[Array, "b n f"]) -> Float[Array, "b f"]:
    """:func:`order_independent_sum` over the devices, with the gradient of a plain sum."""
    return order_independent_sum(x, axis=-2)


@sum_over_devices.defjvp
def _sum_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return sum_over_devices(*primals), jnp.sum(tangents[0], axis=-2)


class RowScore(nn.Module):
    """One number for each row, orthogonal weights times ``gain``, the bits of which do not depend on the row's place.

    A matrix product with one column has other bits in the last rows of a batch than in the first (XLA's CPU kernels); a
    product and a sum over each row by itself have not.
    """

    gain: float

    @nn.compact
    def __call__(self, x: Float[Array, "*b i"]) -> Float[Array, "*b"]:
        """Apply the layer to ``[..., i]``."""
        kernel = self.param("kernel", orthogonal, (x.shape[-1], 1), self.gain)
        return jnp.sum(x * kernel[:, 0], axis=-1) + self.param("bias", nn.initializers.zeros, (1,))[0]


class EquivariantActorCritic(nn.Module):
    """An actor and a critic for any number of devices; permuting the devices permutes the logits to the bit.

    An encoder looks at every device by itself; means and maxima over the devices tell the policy head, again for every
    device by itself, about the others (Zaheer et al., 2017, Deep sets, theorem 2 and section 4). The names of the layers are
    those of the published weights, and seed the initial ones.

    Attributes:
        n_features: features of a device; the rows of an observation hold its mask behind them.
        hidden: widths of the encoder's layers; the last one is that of the heads, too.
    """

    n_features: int
    hidden: tuple[int, ...] = (64, 64)

    def setup(self) -> None:
        """Declare the layers."""
        gain, width = math.sqrt(2.0), self.hidden[-1]
        self.encoder = [OrthogonalDense(size, gain, name=f"looks_{k}") for k, size in enumerate(self.hidden)]
        self.policy_own = OrthogonalDense(width, gain, name="own")
        self.policy_pooled = OrthogonalDense(width, gain, name="others")
        self.policy_head = RowScore(0.01, name="score")
        self.value_hidden = OrthogonalDense(width, gain, name="appraise")
        self.value_head = RowScore(1.0, name="worth")

    def _encode(self, observation: Float[Array, "B obs_size"]) -> tuple[Array, Array, Array]:
        """Embed every device ``[B, n, h]``, pool them ``[B, 2h]``, and return the mask ``[B, n]``."""
        devices = observation.reshape(observation.shape[0], -1, self.n_features + 1)
        mask = devices[..., -1] > 0.5
        x = devices[..., :-1].reshape(-1, self.n_features)
        for layer in self.encoder:
            x = nn.relu(layer(x))
        x = x.reshape(*mask.shape, -1)
        present = jnp.where(mask[..., None], x, 0.0)  # relu leaves nothing below 0, so padding never is the maximum
        count = jnp.maximum(jnp.sum(mask, axis=-1, keepdims=True), 1)
        return x, jnp.concatenate([sum_over_devices(present) / count, jnp.max(present, axis=-2)], axis=-1), mask

    def _logits(self, x: Array, pooled: Array, mask: Array) -> Float[Array, "B n"]:
        own = self.policy_own(x.reshape(-1, x.shape[-1])).reshape(x.shape)
        x = nn.relu(own + self.policy_pooled(pooled)[:, None])
        return jnp.where(mask, self.policy_head(x), ABSENT_LOGIT)

    def _value(self, pooled: Array) -> Float[Array, " B"]:
        return self.value_head(nn.relu(self.value_hidden(pooled)))

    def logits(self, observation: Float[Array, "B obs_size"]) -> Float[Array, "B n"]:
        """Unnormalised log-probabilities of the actions; :data:`ABSENT_LOGIT` where there is no device."""
        return self._logits(*self._encode(observation))

    def value(self, observation: Float[Array, "B obs_size"]) -> Float[Array, " B"]:
        """State values."""
        return self._value(self._encode(observation)[1])

    def __call__(self, observation: Float[Array, "B obs_size"]) -> tuple[Array, Array]:
        """Logits and values."""
        x, pooled, mask = self._encode(observation)
        return self._logits(x, pooled, mask), self._value(pooled)


ABSENT_LOGIT = -1e9
"""Logit of an action that is no device."""

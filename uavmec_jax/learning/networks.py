"""Networks of the learners: small dense stacks, initialised as PyTorch initialises its linear layers."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


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


class QNetwork(nn.Module):
    """The paper's Q-network: ReLU layers, then one value per action.

    Attributes:
        n_actions: number of actions, one per device.
        hidden: widths of the hidden layers; (64, 64) in the paper.
    """

    n_actions: int
    hidden: tuple[int, ...] = (64, 64)

    @nn.compact
    def __call__(self, observation: Float[Array, "... two_n"]) -> Float[Array, "... n"]:
        """Q-values ``[..., n]`` of observations ``[..., 2n]``; at most one batch axis."""
        x = observation
        for width in self.hidden:
            x = nn.relu(TorchDense(width)(x))
        return TorchDense(self.n_actions)(x)

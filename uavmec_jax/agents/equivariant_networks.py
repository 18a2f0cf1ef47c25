"""Networks for any number of devices, in any order."""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from uavmec_jax.agents.networks import LayerNorm, OrthogonalDense, orthogonal
from uavmec_jax.env.fixed_point import order_independent_sum


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


class EquivariantNetwork(nn.Module):
    """An encoder with two heads for any number of devices: a score of each device, and one value.

    An encoder embeds each device on its own. Means and maxima of the embeddings over the devices tell the policy head,
    which scores each device, about the other devices (Zaheer et al., 2017, Deep sets, theorem 2 and section 4). The names
    of the layers are those in the published weights; they also seed the initial weights.

    Attributes:
        n_features: features of a device; each row of an observation is these features and the device's mask.
        hidden: widths of the encoder's layers; the heads have the width of the last one.
        layer_norm: whether each layer of the encoder is normalised before its ReLU (Ba et al., 2016).
    """

    n_features: int
    hidden: tuple[int, ...] = (64, 64)
    layer_norm: bool = False

    def setup(self) -> None:
        """Declare the layers."""
        gain, width = math.sqrt(2.0), self.hidden[-1]
        self.encoder = [OrthogonalDense(size, gain, name=f"looks_{k}") for k, size in enumerate(self.hidden)]
        self.norms = [LayerNorm() for _ in self.hidden] if self.layer_norm else []
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
        for k, layer in enumerate(self.encoder):
            x = layer(x)
            x = nn.relu(self.norms[k](x) if self.layer_norm else x)
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


class EquivariantActorCritic(EquivariantNetwork):
    """An actor and a critic for any number of devices; permuting the devices permutes the logits, to the bit."""

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


class EquivariantQNetwork(EquivariantNetwork):
    """A dueling Q-network for any number of devices: one value plus the devices' scores less their mean.

    Permuting the devices permutes the Q-values.
    """

    def __call__(self, observation: Float[Array, "B obs_size"]) -> Float[Array, "B n"]:
        """Return the Q-values; :data:`ABSENT_LOGIT` where there is no device."""
        x, pooled, mask = self._encode(observation)
        scores = self._logits(x, pooled, mask)
        present = jnp.where(mask, scores, 0.0)
        mean = sum_over_devices(present[..., None])[..., 0] / jnp.maximum(jnp.sum(mask, axis=-1), 1)
        return jnp.where(mask, self._value(pooled)[:, None] + scores - mean[:, None], ABSENT_LOGIT)


ABSENT_LOGIT = -1e9
"""Logit or Q-value of an action that is not a device."""

"""The observations that agents can learn from, the paper's and the full one, and the networks for each."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from uavmec_jax.agents.equivariant_networks import EquivariantActorCritic, EquivariantQNetwork
from uavmec_jax.agents.networks import ActorCritic, QNetwork
from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.observation import observe
from uavmec_jax.env.params import Params
from uavmec_jax.planning.observation import FEATURES, observe_devices


@dataclass(frozen=True)
class ObservationSpec:
    """An observation and the networks that take it.

    Attributes:
        observation_fn: ``(params, layout, state) -> [..., obs_size]``, f32; states may have batch axes in front.
        obs_size: ``(n_devices) -> obs_size``, the length of an observation.
        network: ``(n_devices, hidden) -> module``, an actor and a critic that take observations ``[B, obs_size]``.
        q_network: ``(n_devices, hidden, layer_norm) -> module``, a dueling Q-network for them.
    """

    observation_fn: Callable[[Params, Layout, State], Array]
    obs_size: Callable[[int], int]
    network: Callable[[int, tuple[int, ...]], nn.Module]
    q_network: Callable[[int, tuple[int, ...], bool], nn.Module]


def _flat_full_observation(params: Params, layout: Layout, state: State) -> Float[Array, "*batch obs_size"]:
    """Return the full observation as one row: device after device, each with its features and then its mask."""
    if jnp.ndim(state.slot):
        return jax.vmap(partial(_flat_full_observation, params, layout))(state)
    observation = observe_devices(params, layout, state)
    rows = jnp.concatenate([observation.features, observation.mask[:, None].astype(jnp.float32)], axis=1)
    return rows.reshape(-1)


def _equivariant_network(n_devices: int, hidden: tuple[int, ...]) -> EquivariantActorCritic:
    """Return the networks for the full observation, which are the same for any number of devices."""
    return EquivariantActorCritic(n_features=len(FEATURES), hidden=hidden)


def _dueling_q_network(n_devices: int, hidden: tuple[int, ...], layer_norm: bool) -> QNetwork:
    """Return the Q-network for the paper's observation."""
    return QNetwork(n_actions=n_devices, hidden=hidden, dueling=True, layer_norm=layer_norm)


def _equivariant_q_network(n_devices: int, hidden: tuple[int, ...], layer_norm: bool) -> EquivariantQNetwork:
    """Return the Q-network for the full observation, which is the same for any number of devices."""
    return EquivariantQNetwork(n_features=len(FEATURES), hidden=hidden, layer_norm=layer_norm)


OBSERVATIONS: Mapping[str, ObservationSpec] = MappingProxyType(
    {
        "paper": ObservationSpec(observe, lambda n: 2 * n, ActorCritic, _dueling_q_network),
        "full": ObservationSpec(
            _flat_full_observation, lambda n: n * (len(FEATURES) + 1), _equivariant_network, _equivariant_q_network
        ),
    }
)
"""The observations by their names in study files."""

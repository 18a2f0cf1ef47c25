"""What a learner sees of a state, and the networks made for it: the paper's observation, or the full one."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array

from uavmec_jax.agents.networks import ActorCritic, EquivariantActorCritic
from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.observation import observe
from uavmec_jax.env.params import Params
from uavmec_jax.planning.observation import FEATURES, observe_devices


@dataclass(frozen=True)
class ObservationSpec:
    """One way to observation_fn.

    Attributes:
        observation_fn: ``(params, layout, state) -> [..., obs_size]`` f32; states may have batch axes in front.
        obs_size: ``(n_devices) -> obs_size``.
        network: ``(n_devices, hidden) -> actor and critic`` on batches ``[B, obs_size]``.
    """

    observation_fn: Callable[[Params, Layout, State], Array]
    obs_size: Callable[[int], int]
    network: Callable[[int, tuple[int, ...]], nn.Module]


def _see_all(params: Params, layout: Layout, state: State) -> Array:
    """The full observation, one device after the other, each with its mask behind its features."""
    if jnp.ndim(state.slot):
        return jax.vmap(partial(_see_all, params, layout))(state)
    seen = observe_devices(params, layout, state)
    return jnp.concatenate([seen.features, seen.mask[:, None].astype(jnp.float32)], axis=1).reshape(-1)


def _equivariant(n_devices: int, hidden: tuple[int, ...]) -> Any:
    return EquivariantActorCritic(n_features=len(FEATURES), hidden=hidden)


OBSERVATIONS: Mapping[str, ObservationSpec] = MappingProxyType(
    {
        "paper": ObservationSpec(observe, lambda n: 2 * n, ActorCritic),
        "full": ObservationSpec(_see_all, lambda n: n * (len(FEATURES) + 1), _equivariant),
    }
)
"""Name, as in study files -> what is seen."""

"""How an agent that learns Q-values explores: many epsilons at once, at random or guided by a heuristic."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.env.types import Scalar
from uavmec_jax.planning.heuristics import HEURISTICS, nth_device

NO_GUIDE = "none"
GUIDES = (NO_GUIDE, *(name for name in HEURISTICS if name not in ("random", "stay-put")))
"""What exploration may be guided by: nothing, or a heuristic."""


def spread_epsilons(highest: Scalar, lowest: Scalar, n_envs: int) -> Float[Array, " e"]:
    """Return an epsilon for each environment, spread logarithmically (Horgan et al., 2018, section 4.1).

    Args:
        highest: of the first environment.
        lowest: of the last one.
        n_envs: number of environments; a single one has the geometric mean.
    """
    place = np.arange(n_envs) / (n_envs - 1) if n_envs > 1 else np.full(1, 0.5)
    return highest * (lowest / highest) ** jnp.asarray(place, jnp.float32)


def exploratory_action(
    scenario: Scenario, state: State, guide: str, guidance: Scalar, uniform: Float[Array, " 2"]
) -> Int[Array, ""]:
    """Return an action that is not the greedy one: what the guide does, or a device drawn uniformly.

    Args:
        scenario: of the environment.
        state: before the slot.
        guide: one of :data:`GUIDES`.
        guidance: probability of the guide's action.
        uniform: numbers in [0, 1) that decide whether to follow the guide, and draw the device.
    """
    random = nth_device(scenario.layout, lambda count: jnp.minimum((uniform[1] * count).astype(jnp.int32), count - 1))
    if guide == NO_GUIDE:
        return random
    guided = HEURISTICS[guide](scenario.params, scenario.layout, state)
    return jnp.where(uniform[0] < guidance, guided, random).astype(jnp.int32)

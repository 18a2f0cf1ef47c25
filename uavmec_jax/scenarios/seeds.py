"""What a seed stands for in every study: a layout, and the volume draws held out for it."""

from typing import Any

import jax
import numpy as np

from uavmec_jax.env.layout import Layout, sample_layout
from uavmec_jax.env.params import Params

# Streams of randomness: the seed of the root key. An agent's share of each hangs on its identity.
_LAYOUT, _TRAINING, _VALIDATION, _HELD_OUT, _FIXED = range(5)


def town(seed: Any, params: Params, n_powered: Any, n_connected: Any) -> Layout:
    """The layout that a seed stands for in every study."""
    return sample_layout(jax.random.fold_in(jax.random.key(_LAYOUT), seed), params, n_powered, n_connected)


def held_out_draws(seed: int, powered: int, connected: int, draws: int) -> Any:
    """``[draws]`` volume draws: the first ones that a study judges policies on in this cell and for this seed."""
    numbers = np.array([[seed], [powered], [connected]], np.int32)
    return jax.random.split(_agent_keys(_HELD_OUT, *numbers)[0], draws)


def _agent_keys(stream: int, *numbers: Any) -> Any:
    return jax.vmap(_fold, (None, *(0 for _ in numbers)))(jax.random.key(stream), *numbers)


@jax.jit
def _fold(root: Any, *numbers: Any) -> Any:
    for number in numbers:
        root = jax.random.fold_in(root, number)
    return root

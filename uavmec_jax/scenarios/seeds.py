"""What a seed stands for in every study: a layout, and the volume draws held out for it."""

import enum
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Int, Key

from uavmec_jax.env.layout import Layout, sample_layout
from uavmec_jax.env.params import Params


class Stream(enum.IntEnum):
    """Streams of randomness: the seeds of root keys. An agent's share of each depends on its identity alone."""

    LAYOUT = 0
    TRAINING = 1
    VALIDATION = 2
    HELD_OUT = 3
    FIXED = 4


def layout_for_seed(seed: Any, params: Params, n_powered: Any, n_connected: Any) -> Layout:
    """Return the layout that a seed stands for; lower counts are the same devices with fewer resources."""
    return sample_layout(jax.random.fold_in(jax.random.key(Stream.LAYOUT), seed), params, n_powered, n_connected)


def held_out_draws(seed: int, powered: int, connected: int, draws: int) -> Key[Array, " D"]:
    """Return the first ``draws`` volume draws on which studies evaluate policies for this seed in this cell."""
    numbers = np.array([[seed], [powered], [connected]], np.int32)
    return jax.random.split(identity_keys(Stream.HELD_OUT, *numbers)[0], draws)


def identity_keys(stream: Stream, *numbers: Int[np.ndarray, " A"]) -> Key[Array, " A"]:
    """Return one key for each identity: the root key of a stream, folded with the numbers one after the other."""
    return jax.vmap(_fold, (None, *(0 for _ in numbers)))(jax.random.key(stream), *numbers)


@jax.jit
def _fold(root: Key[Array, ""], *numbers: Any) -> Key[Array, ""]:
    for number in numbers:
        root = jax.random.fold_in(root, number)
    return root

"""Map seeds to layouts and volume draws, the same in every study."""

import enum

import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Int, Key

from uavmec_jax.env.checks import check_range
from uavmec_jax.env.layout import Layout, sample_layout
from uavmec_jax.env.params import Params


class Stream(enum.IntEnum):
    """Streams of randomness, each with the seed of its root key; an agent's key depends on its identity alone."""

    LAYOUT = 0
    TRAINING = 1
    VALIDATION = 2
    HELD_OUT = 3
    """Draws on which policies are evaluated."""
    FIXED = 4
    """The one draw that is the same for every agent."""


MAX_DRAWS = 1_000_000
"""Most draws at once."""


def layout_for_seed(
    seed: Int[ArrayLike, ""], params: Params, n_powered: Int[ArrayLike, ""], n_connected: Int[ArrayLike, ""]
) -> Layout:
    """Return the layout of a seed; with lower counts it has the same devices, fewer of them with power or communication.

    Raises:
        ArgumentError: the seed, a count or a parameter is out of range; one line.
    """
    check_range("seed", seed, ge=0, lt=2**32, whole=True)
    return sample_layout(jax.random.fold_in(jax.random.key(Stream.LAYOUT), seed), params, n_powered, n_connected)


def held_out_draws(seed: int, powered: int, connected: int, draws: int) -> Key[Array, " D"]:
    """Return the first ``draws`` volume draws on which studies evaluate policies in the scenario of a seed.

    Raises:
        ArgumentError: a number is out of range; one line.
    """
    for name, value in (("seed", seed), ("powered", powered), ("connected", connected)):
        check_range(name, value, ge=0, lt=2**31, whole=True)
    check_range("draws", draws, ge=1, le=MAX_DRAWS, whole=True)
    identity = np.array([[seed], [powered], [connected]], np.int32)
    return jax.random.split(identity_keys(Stream.HELD_OUT, *identity)[0], draws)


def identity_keys(stream: Stream, *numbers: Int[np.ndarray, " A"]) -> Key[Array, " A"]:
    """Return one key per agent: the root key of a stream with the numbers of the agent's identity folded in, in order."""
    return jax.vmap(_fold, (None, *(0 for _ in numbers)))(jax.random.key(stream), *numbers)


@jax.jit
def _fold(root: Key[Array, ""], *numbers: Int[Array, ""]) -> Key[Array, ""]:
    for number in numbers:
        root = jax.random.fold_in(root, number)
    return root

"""Replay memory: one row of 32-bit words per transition, 64 bytes for twelve devices.

A row holds what a transition *adds*: the observation it led to, its action, reward and flags. The observation it
started from is the previous row's, or the initial one if an episode ended there. So a sample costs two neighbouring
buffer_state (two cache lines) instead of five scattered arrays, and 75 agents x 1,000,000 transitions fit in 4.5 GiB.
Battery fractions and rewards are kept to the bit; ages are small integers and are packed.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

_ACTION_BITS = 8
_TERMINATED = 1 << _ACTION_BITS
_ENDED = 2 << _ACTION_BITS


class Transition(NamedTuple):
    """A batch of transitions, leading axis ``B``.

    ``observation`` and ``next_observation`` are f32 ``[B, 2n]``, ``action`` int32 ``[B]``, ``reward`` f32 ``[B]``,
    ``terminated`` f32 ``[B]`` (1 where the bootstrap is cut), ``discount`` f32 ``[B]`` of the bootstrap. With n-step
    returns the reward is the discounted sum up to ``next_observation``.
    """

    observation: Array
    action: Array
    reward: Array
    terminated: Array
    next_observation: Array
    discount: Array


@dataclass(frozen=True)
class ReplaySpec:
    """Shape of one agent's memory (static).

    Attributes:
        n_devices: devices, at most 256.
        capacity: transitions that can be sampled.
        stride: transitions written at a time; the ring is a multiple of it, so a write never wraps.
        max_age: largest age that can occur, slots.
        wraps: whether more than ``capacity`` transitions will ever be written.
        n_step: transitions that one sample sums up.
    """

    n_devices: int
    capacity: int
    stride: int = 4
    max_age: int = 11
    wraps: bool = True
    n_step: int = 1

    @property
    def ring(self) -> int:
        """Transitions held: the capacity plus at least the one whose start the oldest needs, in whole strides."""
        held = self.capacity + (1 if self.wraps else 0)
        return -(-held // self.stride) * self.stride

    @property
    def age_bits(self) -> int:
        """Bits per packed age."""
        return max(int(self.max_age).bit_length(), 1)

    @property
    def ages_per_word(self) -> int:
        """Ages in one 32-bit word."""
        return 32 // self.age_bits

    @property
    def words(self) -> int:
        """Words per row: batteries, packed ages, reward, and one for action and flags."""
        return self.n_devices + -(-self.n_devices // self.ages_per_word) + 2

    @property
    def bytes(self) -> int:
        """Memory of one agent, bytes."""
        return 4 * (self.ring + 1) * self.words


def init(spec: ReplaySpec) -> UInt[Array, "buffer_state words"]:
    """An empty memory ``[ring + 1, words]``; row 0 stands before the first transition: an episode ended there."""
    buffer_state = jnp.zeros((spec.ring + 1, spec.words), jnp.uint32)
    return buffer_state.at[0, -1].set(_ENDED)


def pack(
    spec: ReplaySpec,
    action: Int[Array, ""],
    reward: Float[Array, ""],
    battery_fraction: Float[Array, " n"],
    age: Int[Array, " n"],
    terminated: Bool[Array, ""],
    ended: Bool[Array, ""],
) -> UInt[Array, " words"]:
    """One row from what a slot led to; ``ended`` is terminated or truncated."""
    words = -(-spec.n_devices // spec.ages_per_word)
    padded = jnp.pad(age.astype(jnp.uint32), (0, words * spec.ages_per_word - spec.n_devices))
    shifts = np.arange(spec.ages_per_word, dtype=np.uint32) * spec.age_bits
    ages = jnp.sum(padded.reshape(words, spec.ages_per_word) << shifts, axis=-1, dtype=jnp.uint32)
    tag = action.astype(jnp.uint32) | jnp.where(terminated, _TERMINATED, 0).astype(jnp.uint32)
    tag = tag | jnp.where(ended, _ENDED, 0).astype(jnp.uint32)
    bits = jax.lax.bitcast_convert_type
    return jnp.concatenate([bits(battery_fraction, jnp.uint32), ages, bits(reward, jnp.uint32)[None], tag[None]])


def add(
    spec: ReplaySpec,
    buffer_state: UInt[Array, "buffer_state words"],
    written: Int[Array, ""],
    new: UInt[Array, "stride words"],
) -> UInt[Array, "buffer_state words"]:
    """Write ``stride`` buffer_state; ``written`` (a multiple of ``stride``) transitions were written before."""
    place = written % spec.ring
    buffer_state = jax.lax.dynamic_update_slice(buffer_state, new, (place + 1, 0))
    if spec.wraps:  # row 0 is the neighbour of row 1: once the ring is full, the ring's last row
        first = jnp.where(place + spec.stride == spec.ring, new[-1], buffer_state[0])
        buffer_state = jax.lax.dynamic_update_slice(buffer_state, first[None], (0, 0))
    return buffer_state


def sample(
    spec: ReplaySpec,
    buffer_state: UInt[Array, "buffer_state words"],
    written: Int[Array, ""],
    bits: UInt[Array, " B"],
    gamma: Any,
) -> Transition:
    """Draw transitions uniformly with replacement from the newest ``min(written, capacity)``.

    Args:
        spec: shape of the memory.
        buffer_state: the memory.
        written: transitions written so far, at least 1.
        bits: ``[B]`` uniform 32-bit words, one per draw. (The modulo's bias is below capacity / 2**32.)
        gamma: discount of one slot.
    """
    size = jnp.minimum(written, spec.capacity)
    back = (bits % size.astype(jnp.uint32)).astype(jnp.int32)
    place = (written - 1 - back) % spec.ring
    pairs = jax.vmap(lambda start: jax.lax.dynamic_slice(buffer_state, (start, 0), (2, spec.words)))(place)
    before, row = pairs[:, 0], pairs[:, 1]
    first = np.concatenate([np.ones(spec.n_devices, np.float32), np.zeros(spec.n_devices, np.float32)])
    reward, discount, last = _reward(row), jnp.broadcast_to(jnp.asarray(gamma, jnp.float32), back.shape), row
    if spec.n_step > 1:
        reward, discount, last = _n_step(spec, buffer_state, place, back, row, gamma)
    return Transition(
        observation=jnp.where((before[:, -1:] & _ENDED) > 0, first, _observation(spec, before)),
        action=(row[:, -1] & (_TERMINATED - 1)).astype(jnp.int32),
        reward=reward,
        terminated=((last[:, -1] & _TERMINATED) > 0).astype(jnp.float32),
        next_observation=_observation(spec, last),
        discount=discount,
    )


def _n_step(
    spec: ReplaySpec,
    buffer_state: UInt[Array, "buffer_state words"],
    place: Int[Array, " B"],
    back: Int[Array, " B"],
    row: UInt[Array, "B words"],
    gamma: Any,
) -> tuple[Array, Array, Array]:
    """Discounted sum of up to ``n_step`` rewards, discount of the bootstrap, and the last row summed.

    A sum stops where an episode ends and at the newest transition, as in Stable-Baselines3; it is then bootstrapped
    after the slots it has.
    """
    goes_on = jnp.ones(place.shape, bool)
    total, discount, last = jnp.zeros(place.shape), jnp.ones(place.shape), row
    for k in range(spec.n_step):
        now = buffer_state[1 + (place + k) % spec.ring]
        goes_on = goes_on & (back >= k)
        total = total + jnp.where(goes_on, discount * _reward(now), 0.0)
        discount = jnp.where(goes_on, discount * gamma, discount)
        last = jnp.where(goes_on[:, None], now, last)
        goes_on = goes_on & ((now[:, -1] & _ENDED) == 0)
    return total, discount, last


def _reward(row: UInt[Array, "B words"]) -> Float[Array, " B"]:
    return jax.lax.bitcast_convert_type(row[:, -2], jnp.float32)


def _observation(spec: ReplaySpec, row: UInt[Array, "B words"]) -> Float[Array, "B two_n"]:
    """The observation a row led to."""
    n = spec.n_devices
    shifts = (np.arange(n, dtype=np.uint32) % spec.ages_per_word) * spec.age_bits
    words = jnp.repeat(row[:, n:-2], spec.ages_per_word, axis=-1)[:, :n]
    ages = (words >> shifts) & np.uint32(2**spec.age_bits - 1)
    return jnp.concatenate([jax.lax.bitcast_convert_type(row[:, :n], jnp.float32), ages.astype(jnp.float32)], axis=-1)

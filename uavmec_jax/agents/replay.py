"""The replay buffer: one row of 32-bit words per transition, 64 bytes for twelve devices.

A row holds what a transition *adds*: the next observation, the action, the reward and flags. The observation before the
transition is that of the previous row, or the initial one if an episode ended there. A sample therefore reads two
neighbouring rows (two cache lines) instead of five scattered arrays, and 75 agents with 1,000,000 transitions each fit in
4.5 GiB. Battery fractions and rewards are stored exactly; ages are small integers and are packed.

The functions are pure; ``buffer_state`` is the array of all rows. :func:`add`, :func:`sample_rows` and :func:`flags_word`
also serve the rows of :mod:`uavmec_jax.agents.state_replay`, whose last two words are the reward and the flags, too.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, Bool, Float, Int, UInt

from uavmec_jax.env.types import Scalar

_ACTION_BITS = 8
MAX_ACTIONS = 1 << _ACTION_BITS
"""Largest number of actions that a row can tell apart."""
TERMINATED = 1 << _ACTION_BITS
"""Flag in a row's last word: the episode terminated."""
ENDED = 2 << _ACTION_BITS
"""Flag in a row's last word: the episode terminated or was truncated."""
_ROW_BY_ROW = Layout((0, 1))
"""How the rows lie in memory: in order, those of each agent together. XLA would choose another order for a loop on a GPU, and
copy all buffers, transposed, at its beginning and end."""


class Transition(NamedTuple):
    """A batch of transitions.

    Attributes:
        observation: the observation before the action.
        action: the device visited.
        reward: the reward; with n-step returns the discounted sum of the rewards up to ``next_observation``.
        terminated: 1 if the episode terminated in ``next_observation``, so that nothing is bootstrapped from it, else 0.
        next_observation: the observation to bootstrap from.
        discount: discount factor of the bootstrapped value.
    """

    observation: Float[Array, "*batch B obs_size"]
    action: Int[Array, "*batch B"]
    reward: Float[Array, "*batch B"]
    terminated: Float[Array, "*batch B"]
    next_observation: Float[Array, "*batch B obs_size"]
    discount: Float[Array, "*batch B"]


class SampledRows(NamedTuple):
    """The rows that a batch of samples is made of.

    Attributes:
        before: each sample's previous row.
        row: its own row.
        last: the row of the last transition that it sums up; its own without n-step returns.
        reward: as in :class:`Transition`.
        discount: as in :class:`Transition`.
    """

    before: UInt[Array, "B words"]
    row: UInt[Array, "B words"]
    last: UInt[Array, "B words"]
    reward: Float[Array, " B"]
    discount: Float[Array, " B"]

    @property
    def starts(self) -> Bool[Array, " B"]:
        """Whether each sample is the first transition of its episode."""
        return (self.before[:, -1] & ENDED) > 0

    @property
    def terminated(self) -> Float[Array, " B"]:
        """As in :class:`Transition`."""
        return ((self.last[:, -1] & TERMINATED) > 0).astype(jnp.float32)


@dataclass(frozen=True)
class RingSpec:
    """Shape of a ring of rows (static); what is in a row is left to the subclasses.

    Attributes:
        n_devices: number of devices.
        capacity: number of transitions that can be sampled.
        stride: number of transitions written at a time; the ring is a multiple of it, so no single write wraps around.
        wraps: whether more than ``capacity`` transitions will be written.
        n_step: number of transitions that one sample sums up.
    """

    n_devices: int
    capacity: int
    stride: int = 4
    wraps: bool = True
    n_step: int = 1

    @property
    def ring(self) -> int:
        """Number of transitions held: the capacity, one more if the ring wraps, rounded up to whole strides.

        The oldest sample needs the row before its own.
        """
        needed = self.capacity + (1 if self.wraps else 0)
        return -(-needed // self.stride) * self.stride

    @property
    def words(self) -> int:
        """Number of words in a row."""
        raise NotImplementedError

    @property
    def bytes(self) -> int:
        """Memory of one agent, bytes."""
        return 4 * (self.ring + 1) * self.words


@dataclass(frozen=True)
class ReplaySpec(RingSpec):
    """Shape of one agent's replay buffer of the paper's observations; at most :data:`MAX_ACTIONS` devices.

    Attributes:
        max_age: largest age that can occur, slots.
    """

    max_age: int = 11

    @property
    def age_bits(self) -> int:
        """Number of bits of a packed age."""
        return max(int(self.max_age).bit_length(), 1)

    @property
    def ages_per_word(self) -> int:
        """Number of ages in a 32-bit word."""
        return 32 // self.age_bits

    @property
    def words(self) -> int:
        """Number of words in a row: batteries, packed ages, the reward, and one word for the action and the flags."""
        return self.n_devices + -(-self.n_devices // self.ages_per_word) + 2


def init(spec: RingSpec) -> UInt[Array, "rows words"]:
    """Return an empty buffer, ``[ring + 1, words]``. Row 0, before the first transition, says that an episode ended."""
    buffer_state = jnp.zeros((spec.ring + 1, spec.words), jnp.uint32)
    return buffer_state.at[0, -1].set(ENDED)


def pack(
    spec: ReplaySpec,
    action: Int[Array, ""],
    reward: Float[Array, ""],
    battery_fraction: Float[Array, " n"],
    age: Int[Array, " n"],
    terminated: Bool[Array, ""],
    ended: Bool[Array, ""],
) -> UInt[Array, " words"]:
    """Pack a transition into one row.

    Args:
        spec: shape of the buffer.
        action: the device visited.
        reward: the reward.
        battery_fraction: each device's battery after the slot, a share of its capacity.
        age: each device's data age after the slot.
        terminated: whether the episode terminated.
        ended: whether the episode terminated or was truncated.
    """
    words = -(-spec.n_devices // spec.ages_per_word)
    padded = jnp.pad(age.astype(jnp.uint32), (0, words * spec.ages_per_word - spec.n_devices))
    shifts = np.arange(spec.ages_per_word, dtype=np.uint32) * spec.age_bits
    ages = jnp.sum(padded.reshape(words, spec.ages_per_word) << shifts, axis=-1, dtype=jnp.uint32)
    tag = flags_word(action.astype(jnp.uint32), terminated, ended)
    bits = jax.lax.bitcast_convert_type
    return jnp.concatenate([bits(battery_fraction, jnp.uint32), ages, bits(reward, jnp.uint32)[None], tag[None]])


def flags_word(word: UInt[Array, ""], terminated: Bool[Array, ""], ended: Bool[Array, ""]) -> UInt[Array, ""]:
    """Return a row's last word: ``word``, which is less than :data:`MAX_ACTIONS`, and the flags."""
    word = word | jnp.where(terminated, TERMINATED, 0).astype(jnp.uint32)
    return word | jnp.where(ended, ENDED, 0).astype(jnp.uint32)


def add(
    spec: RingSpec,
    buffer_state: UInt[Array, "rows words"],
    written: Int[Array, ""],
    new_rows: UInt[Array, "stride words"],
) -> UInt[Array, "rows words"]:
    """Write ``stride`` rows; ``written`` transitions, a multiple of ``stride``, were written before."""
    position = written % spec.ring
    buffer_state = jax.lax.dynamic_update_slice(buffer_state, new_rows, (position + 1, 0))
    if spec.wraps:  # row 0 is what row 1 follows: once the ring is full, a copy of the ring's last row
        first = jnp.where(position + spec.stride == spec.ring, new_rows[-1], buffer_state[0])
        buffer_state = jax.lax.dynamic_update_slice(buffer_state, first[None], (0, 0))
    return with_layout_constraint(buffer_state, _ROW_BY_ROW)


def sample(
    spec: ReplaySpec,
    buffer_state: UInt[Array, "rows words"],
    written: Int[Array, ""],
    bits: UInt[Array, " B"],
    gamma: Scalar,
) -> Transition:
    """Sample transitions uniformly, with replacement, from the newest ``min(written, capacity)``.

    Args:
        spec: shape of the buffer.
        buffer_state: the rows.
        written: number of transitions written so far, at least 1.
        bits: one uniform 32-bit word per sample. (The bias of the modulo is below capacity / 2**32.)
        gamma: discount factor of one slot.
    """
    rows = sample_rows(spec, buffer_state, written, bits, gamma)
    initial = np.concatenate([np.ones(spec.n_devices, np.float32), np.zeros(spec.n_devices, np.float32)])
    return Transition(
        observation=jnp.where(rows.starts[:, None], initial, _observation(spec, rows.before)),
        action=(rows.row[:, -1] & (TERMINATED - 1)).astype(jnp.int32),
        reward=rows.reward,
        terminated=rows.terminated,
        next_observation=_observation(spec, rows.last),
        discount=rows.discount,
    )


def sample_rows(
    spec: RingSpec,
    buffer_state: UInt[Array, "rows words"],
    written: Int[Array, ""],
    bits: UInt[Array, " B"],
    gamma: Scalar,
    oldest: Int[Array, ""] | None = None,
) -> SampledRows:
    """Sample the rows of transitions uniformly, with replacement, from the newest ``min(written, capacity)``.

    Args:
        spec: shape of the buffer.
        buffer_state: the rows.
        written: number of transitions written so far, at least 1.
        bits: one uniform 32-bit word per sample.
        gamma: discount factor of one slot.
        oldest: number of the oldest transition that may be sampled, less than ``written``; ``None``: all may.
    """
    size = jnp.minimum(written, spec.capacity)
    if oldest is not None:
        size = jnp.minimum(size, written - oldest)
    back = (bits % size.astype(jnp.uint32)).astype(jnp.int32)
    position = (written - 1 - back) % spec.ring
    pairs = jax.vmap(lambda start: jax.lax.dynamic_slice(buffer_state, (start, 0), (2, spec.words)))(position)
    before, row = pairs[:, 0], pairs[:, 1]
    reward, discount, last = _reward(row), jnp.broadcast_to(jnp.asarray(gamma, jnp.float32), back.shape), row
    if spec.n_step > 1:
        reward, discount, last = _n_step(spec, buffer_state, position, back, gamma)
    return SampledRows(before=before, row=row, last=last, reward=reward, discount=discount)


def _n_step(
    spec: RingSpec,
    buffer_state: UInt[Array, "rows words"],
    position: Int[Array, " B"],
    back: Int[Array, " B"],
    gamma: Scalar,
) -> tuple[Float[Array, " B"], Float[Array, " B"], UInt[Array, "B words"]]:
    """Return the discounted sum of up to ``n_step`` rewards, the discount of the bootstrap, and the last row summed.

    A sum stops where an episode ends and at the newest transition, as in Stable-Baselines3, and is bootstrapped there.

    Args:
        spec: shape of the buffer.
        buffer_state: the rows.
        position: place of each sample's first transition in the ring.
        back: number of transitions written after it.
        gamma: discount factor of one slot.
    """
    # Of the rows in between, only the last two words are read: the reward and the tag.
    rows = 1 + (position[:, None] + np.arange(spec.n_step)) % spec.ring
    ends = buffer_state[rows, -2:]
    rewards, is_end = _reward(ends), (ends[..., -1] & ENDED) > 0
    continues = jnp.ones(position.shape, bool)
    total, discount = jnp.zeros(position.shape), jnp.ones(position.shape)
    summed = jnp.zeros(position.shape, jnp.int32)
    for k in range(spec.n_step):
        continues = continues & (back >= k)
        total = total + jnp.where(continues, discount * rewards[:, k], 0.0)
        discount = jnp.where(continues, discount * gamma, discount)
        summed = summed + continues
        continues = continues & ~is_end[:, k]
    return total, discount, buffer_state[1 + (position + summed - 1) % spec.ring]


def _reward(row: UInt[Array, "*B words"]) -> Float[Array, "*B"]:
    """Unpack the rewards of rows."""
    return jax.lax.bitcast_convert_type(row[..., -2], jnp.float32)


def _observation(spec: ReplaySpec, row: UInt[Array, "B words"]) -> Float[Array, "B two_n"]:
    """Unpack the next observations of rows."""
    n = spec.n_devices
    shifts = (np.arange(n, dtype=np.uint32) % spec.ages_per_word) * spec.age_bits
    words = jnp.repeat(row[:, n:-2], spec.ages_per_word, axis=-1)[:, :n]
    ages = (words >> shifts) & np.uint32(2**spec.age_bits - 1)
    return jnp.concatenate([jax.lax.bitcast_convert_type(row[:, :n], jnp.float32), ages.astype(jnp.float32)], axis=-1)

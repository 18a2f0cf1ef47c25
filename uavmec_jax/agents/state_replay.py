"""The replay buffer of states, for observations that are long or depend on the scenario.

A row holds what an observation reads of the *next* state (batteries in J, ages, the UAV's place and energy, the time), the
number of the episode, the action, the reward and flags; the state before the transition is that of the previous row, or the
initial one if an episode ended there. Observations are computed anew for every sample: 128 bytes per transition of twelve
devices instead of 2,880. The scenario of an episode is looked up by its number
(:class:`uavmec_jax.agents.episode.RunningEpisode`).

The functions are pure; ``buffer_state`` is the array of all rows, which :func:`uavmec_jax.agents.replay.init` makes and
:func:`uavmec_jax.agents.replay.add` writes.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt

from uavmec_jax.agents.replay import RingSpec, SampledRows, Transition, flags_word, sample_rows
from uavmec_jax.env.dynamics import State, initial_state
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.types import Scalar

_EPISODE, _ACTION = -4, -3
"""Words of a row, before the reward and the flags."""


@dataclass(frozen=True)
class StateReplaySpec(RingSpec):
    """Shape of one agent's replay buffer of states, for one UAV without depots."""

    @property
    def words(self) -> int:
        """Number of words in a row: batteries, ages, three of the UAV, the time, episode, action, reward and flags."""
        return 2 * self.n_devices + 8


def pack(
    spec: StateReplaySpec,
    action: Int[Array, ""],
    reward: Float[Array, ""],
    after: State,
    episode: Int[Array, ""],
    terminated: Bool[Array, ""],
    ended: Bool[Array, ""],
) -> UInt[Array, " words"]:
    """Pack a transition into one row.

    Args:
        spec: shape of the buffer.
        action: the device visited.
        reward: the reward.
        after: the state after the slot.
        episode: number of the episode.
        terminated: whether the episode terminated.
        ended: whether the episode terminated or was truncated.
    """
    elapsed = jnp.asarray(after.elapsed, jnp.float32)
    parts = (after.battery, after.age, after.uav_position, after.uav_energy, elapsed, episode, action, reward)
    words = [jax.lax.bitcast_convert_type(part, jnp.uint32).ravel() for part in parts]
    row = jnp.concatenate([*words, flags_word(jnp.uint32(0), terminated, ended)[None]])
    assert row.shape == (spec.words,)
    return row


def sample(
    spec: StateReplaySpec,
    buffer_state: UInt[Array, "rows words"],
    written: Int[Array, ""],
    bits: UInt[Array, " B"],
    gamma: Scalar,
    *,
    oldest: Int[Array, ""] | None,
    scenario_of: Callable[[Int[Array, ""]], tuple[Params, Layout]],
    observation_fn: Callable[[Params, Layout, State], Array],
) -> Transition:
    """Sample transitions uniformly, with replacement, and compute their observations.

    Args:
        spec: shape of the buffer.
        buffer_state: the rows.
        written: number of transitions written so far, at least 1.
        bits: one uniform 32-bit word per sample.
        gamma: discount factor of one slot.
        oldest: number of the oldest transition whose scenario is still known; ``None``: all are.
        scenario_of: ``(episode) -> (params, layout)`` of the scenario in which an episode is played.
        observation_fn: ``(params, layout, state) -> [..., obs_size]``.
    """
    rows = sample_rows(spec, buffer_state, written, bits, gamma, oldest)

    def observations(
        starts: Bool[Array, ""], before: UInt[Array, " words"], episode: Int[Array, ""], last: UInt[Array, " words"]
    ) -> Float[Array, "2 obs_size"]:
        """Return the observations before a sample and after it, which are of one episode."""
        params, layout = scenario_of(episode)
        first = initial_state(params, layout)
        earlier = jax.tree.map(lambda new, old: jnp.where(starts, new, old), first, _unpack(spec, first, before))
        both = jax.tree.map(lambda *leaves: jnp.stack(leaves), earlier, _unpack(spec, first, last))
        return observation_fn(params, layout, both)

    observation = jax.vmap(observations)(rows.starts, rows.before, _int_word(rows, _EPISODE), rows.last)
    return Transition(
        observation=observation[:, 0],
        action=_int_word(rows, _ACTION),
        reward=rows.reward,
        terminated=rows.terminated,
        next_observation=observation[:, 1],
        discount=rows.discount,
    )


def _int_word(rows: SampledRows, word: int) -> Int[Array, " B"]:
    """Unpack an integer of each sample's own row."""
    return jax.lax.bitcast_convert_type(rows.row[:, word], jnp.int32)


def _unpack(spec: StateReplaySpec, first: State, row: UInt[Array, " words"]) -> State:
    """Unpack a state; what observations do not read is as in ``first``, the initial state."""
    n = spec.n_devices
    energies = jax.lax.bitcast_convert_type(row, jnp.float32)
    return replace(
        first,
        battery=energies[:n],
        age=jax.lax.bitcast_convert_type(row[n : 2 * n], jnp.int32),
        uav_position=energies[None, 2 * n : 2 * n + 2],
        uav_energy=energies[2 * n + 2 : 2 * n + 3],
        elapsed=energies[2 * n + 3],
    )

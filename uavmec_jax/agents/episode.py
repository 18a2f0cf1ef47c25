"""The episode that an agent with a replay plays: in a scenario of its own, if the agent has a distribution.

The scenarios of the last ``M`` episodes are kept in a ring, one row of 32-bit words each, because samples of the replay need
them. A row also says with which transition its episode began: samples are not older than the oldest of these transitions
(:func:`oldest_transition`), so a scenario that has been overwritten is never looked up.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Int, UInt

from uavmec_jax.agents.algorithm import Agent
from uavmec_jax.agents.environments import SCENARIOS_STREAM
from uavmec_jax.env.generator import ScenarioDistribution, sample_scenario
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import make_reward
from uavmec_jax.env.scenario import Scenario


@struct.dataclass
class RunningEpisode:
    """The running episode of an agent that draws its scenarios.

    Attributes:
        number: of the episode, from 0, int32.
        scenario: in which it is played.
        ring: parameters and layouts of the last ``M`` episodes, that of episode ``e`` in row ``e % M``; the last word is the
            number of transitions before the episode. ``None`` if no sample needs them.
    """

    number: Int[Array, "*batch"]
    scenario: Scenario
    ring: UInt[Array, "*batch M words"] | None


def start(agent: Agent, ring_size: int) -> RunningEpisode | None:
    """Start the first episode; ``None`` if the agent has one scenario for all.

    Args:
        agent: who plays.
        ring_size: number ``M`` of scenarios kept, at least 2; 0: none is.
    """
    if isinstance(agent.scenario, Scenario):
        return None
    number, scenario = jnp.int32(0), _draw(agent, jnp.int32(0))
    row = _pack(scenario, jnp.int32(0))
    ring = jnp.zeros((ring_size, row.shape[0]), jnp.uint32).at[0].set(row) if ring_size else None
    return RunningEpisode(number=number, scenario=scenario, ring=ring)


def follow(
    agent: Agent, episode: RunningEpisode | None, ended: Bool[Array, ""], played: Int[Array, ""]
) -> RunningEpisode | None:
    """Return the next episode, in a newly drawn scenario, if the running one has ``ended``.

    Args:
        agent: who plays.
        episode: the running one; ``None`` if the agent has one scenario for all.
        ended: whether it has ended.
        played: number of transitions so far.
    """
    if episode is None:
        return None
    number = episode.number + ended
    drawn = _draw(agent, number)
    scenario = jax.tree.map(lambda new, old: jnp.where(ended, new, old), drawn, episode.scenario)
    ring = episode.ring
    if ring is not None:
        place = number % ring.shape[0]
        ring = ring.at[place].set(jnp.where(ended, _pack(drawn, played), ring[place]))
    return RunningEpisode(number=number, scenario=scenario, ring=ring)


def scenario_of(agent: Agent, episode: RunningEpisode | None) -> Scenario:
    """Return the scenario of the running episode."""
    if episode is not None:
        return episode.scenario
    assert isinstance(agent.scenario, Scenario)
    return agent.scenario


def kept_scenario(agent: Agent, episode: RunningEpisode | None, number: Int[Array, ""]) -> tuple[Params, Layout]:
    """Return parameters and layout of one of the episodes that began with :func:`oldest_transition` or later."""
    scenario = scenario_of(agent, episode)
    if episode is None:
        return scenario.params, scenario.layout
    assert episode.ring is not None
    return _unpack(scenario, episode.ring[number % episode.ring.shape[0]])


def oldest_transition(episode: RunningEpisode | None) -> Int[Array, ""] | None:
    """Return the number of the first transition whose scenario is in the ring; ``None`` if all are known.

    It is older than the newest transition: the ring holds at least one episode besides the running one.
    """
    if episode is None or episode.ring is None:
        return None
    size = episode.ring.shape[0]
    oldest = jnp.maximum(episode.number - size + 1, 0) % size
    return jax.lax.bitcast_convert_type(episode.ring[oldest, -1], jnp.int32)


def ring_bytes(n_devices: int, ring_size: int) -> int:
    """Return the memory of one agent's ring, bytes."""
    distribution = ScenarioDistribution(params=Params(n_devices=n_devices), reward=make_reward())
    row = jax.eval_shape(lambda key: _pack(sample_scenario(distribution, key), jnp.int32(0)), jax.random.key(0))
    return 4 * ring_size * row.shape[0]


def _draw(agent: Agent, number: Int[Array, ""]) -> Scenario:
    """Draw the scenario of an episode."""
    assert isinstance(agent.scenario, ScenarioDistribution)
    key = jax.random.fold_in(jax.random.fold_in(agent.key, SCENARIOS_STREAM), number)
    return jax.tree.map(jnp.asarray, sample_scenario(agent.scenario, key))


def _pack(scenario: Scenario, played: Int[Array, ""]) -> UInt[Array, " words"]:
    """Pack the parameters and the layout of a scenario, and the number of transitions before its episode, into a row."""
    leaves = [*jax.tree.leaves((scenario.params, scenario.layout)), played]
    return jnp.concatenate([_words(jnp.asarray(leaf)) for leaf in leaves])


def _words(leaf: Array) -> UInt[Array, " words"]:
    """Return the words of a leaf of 32-bit numbers or truth values."""
    if leaf.dtype == bool:
        return leaf.astype(jnp.uint32).ravel()
    return jax.lax.bitcast_convert_type(leaf, jnp.uint32).ravel()


def _unpack(like: Scenario, row: UInt[Array, " words"]) -> tuple[Params, Layout]:
    """Unpack the parameters and the layout of a scenario, which have the shapes of those of ``like``."""
    leaves, tree = jax.tree.flatten((like.params, like.layout))
    ends = np.cumsum([leaf.size for leaf in leaves])

    def unpack(leaf: Array, end: int) -> Array:
        words = row[end - leaf.size : end].reshape(leaf.shape)
        return words > 0 if leaf.dtype == bool else jax.lax.bitcast_convert_type(words, leaf.dtype)

    unpacked: Any = jax.tree.unflatten(tree, [unpack(leaf, int(end)) for leaf, end in zip(leaves, ends, strict=True)])
    return unpacked

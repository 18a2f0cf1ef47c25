"""Scenarios, and one slot of one with its reward."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from uavmec_jax.env.dynamics import Cause, Outcome, State, initial_state, transition
from uavmec_jax.env.layout import Layout, sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import Reward, make_reward, reward_of, traffic_reward


@struct.dataclass
class Scenario:
    """Everything that makes one problem: the ``params`` argument of :class:`UavMecEnv`. Batched by ``vmap``."""

    params: Params
    layout: Layout
    reward: Reward


def make_scenario(layout: Layout | None = None, params: Params | None = None, reward: Reward | None = None) -> Scenario:
    """A scenario from its parts; by default a layout of seed 0 with 8 powered and 8 connected devices."""
    params = Params() if params is None else params
    if layout is None:
        share = (2 * params.n_devices) // 3
        layout = sample_layout(jax.random.key(0), params, share, share)
    return Scenario(params=params, layout=layout, reward=make_reward() if reward is None else reward)


def draw_volumes(params: Params, uniform: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Task volumes in bytes from uniform numbers in [0, 1)."""
    low, high = params.task_volume_range_bytes
    return low + uniform * (high - low)


def advance(
    scenario: Scenario, state: State, action: Int[ArrayLike, ""], volumes: Float[Array, " n"]
) -> tuple[State, Float[Array, ""], Outcome]:
    """One slot with explicit volumes and no reset: next state, reward, outcome."""
    after, outcome = transition(scenario.params, scenario.layout, state, action, volumes)
    reward = reward_of(scenario.reward, scenario.layout, state, action, after)
    if scenario.layout.traffic is not None:  # other towns keep the bits and the speed that they have
        reward += traffic_reward(scenario.reward, scenario.layout, state, action, outcome)
    return after, reward, outcome


def is_truncated(scenario: Scenario, state: State, outcome: Outcome) -> Array:
    """Whether the time limit, and nothing else, ends the episode here."""
    return (outcome.cause == Cause.NONE) & (state.slot >= scenario.params.max_slots)


def auto_reset(ended: Bool[Array, ""], scenario: Scenario, state: State) -> State:
    """The state an episode goes on from: a fresh one where it has ended."""
    fresh = initial_state(scenario.params, scenario.layout)
    return jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, state)

"""Scenarios, and one slot of a scenario with its reward."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from uavmec_jax.env.dynamics import Cause, Outcome, State, fresh_state, living_devices, transition
from uavmec_jax.env.layout import Layout, sample_layout
from uavmec_jax.env.params import Params, check_params
from uavmec_jax.env.rewards import Reward, check_guard, check_reward, make_reward, reward_of, traffic_reward
from uavmec_jax.env.scenario_checks import check_scenario


@struct.dataclass
class Scenario:
    """A problem instance: the ``params`` argument of :class:`UavMecEnv`. ``vmap`` batches it.

    Attributes:
        params: the simulation parameters.
        layout: the devices.
        reward: what a policy is rewarded for.
    """

    params: Params
    layout: Layout
    reward: Reward


def make_scenario(layout: Layout | None = None, params: Params | None = None, reward: Reward | None = None) -> Scenario:
    """Return a scenario made of the given parts.

    Args:
        layout: by default a random layout in which two thirds of the devices have power and two thirds communication.
        params: by default those of the paper.
        reward: by default the one that the paper found best.

    Raises:
        ArgumentError: a value is out of range, or the layout has another number of devices than the parameters; one line.
            Traced values are checked only inside :func:`um.debug_checks`.
        ValueError: there are depots, and the reward has a bare logarithm of an age, which is 0 at a depot.
    """
    params = Params() if params is None else params
    if layout is None:
        count = (2 * params.n_devices) // 3
        layout = sample_layout(jax.random.key(0), params, count, count)
    if reward is None:
        reward = make_reward(guard="log1p" if layout.n_depots else "clamp")
    check_scenario(params, layout)
    check_reward(reward)
    check_guard(reward, layout)
    return Scenario(params=params, layout=layout, reward=reward)


def draw_volumes(params: Params, uniform: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Turn uniform random numbers in [0, 1) into task volumes in bytes.

    Raises:
        ArgumentError: a parameter is out of range; one line.
    """
    check_params(params)
    low, high = params.task_volume_range_bytes
    return low + uniform * (high - low)


def advance(
    scenario: Scenario,
    state: State,
    action: Num[ArrayLike, ""] | Num[Array, " K"],
    volumes: Float[Array, " n"],
) -> tuple[State, Float[Array, ""], Outcome]:
    """Play one slot with explicit volumes, without a reset, and return the next state, the reward and the outcome."""
    after, outcome = transition(scenario.params, scenario.layout, state, action, volumes)
    params, layout = scenario.params, scenario.layout
    reward = reward_of(scenario.reward, layout, state, action, after, params)
    if layout.traffic is not None:  # known when tracing: other layouts do not pay for it
        living = living_devices(params, layout, state)
        reward += traffic_reward(scenario.reward, layout, state, action, outcome, living)
    return after, reward, outcome


def is_truncated(scenario: Scenario, state: State, outcome: Outcome) -> Bool[Array, ""]:
    """Return whether the time limit, and no failure, ends the episode in this state."""
    return (outcome.cause == Cause.NONE) & (state.slot >= scenario.params.max_slots)


def auto_reset(ended: Bool[Array, ""], scenario: Scenario, before: State, after: State) -> State:
    """Return the initial state if the slot from ``before`` to ``after`` has ended the episode, else ``after``."""
    fresh = fresh_state(scenario.params, scenario.layout)
    state = jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, after)
    if scenario.params.end == "first_failure":  # what no slot changes that an episode goes on from costs a loop nothing
        state = replace(state, failed_at=before.failed_at)
        if not scenario.layout.action_shape and not scenario.layout.n_depots:
            state = replace(state, grounded=before.grounded, packs=before.packs)
    return state

"""The environment a learner sees: scenarios, observations, and the signatures of gymnax 1.0."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from uavmec_jax.world.layout import Layout, sample_layout
from uavmec_jax.world.params import Params
from uavmec_jax.world.physics import Cause, Outcome, State, initial_state, transition
from uavmec_jax.world.rewards import Reward, make_reward, reward_of, traffic_reward


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


def observe(layout: Layout, state: State) -> Float[Array, "*b two_n"]:
    """The paper's observation, ``[..., 2n]`` f32: n battery fractions in [0, 1], then n data ages as plain counts."""
    return jnp.concatenate([state.battery / layout.capacity, state.age.astype(jnp.float32)], axis=-1)


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


def restart_if(ended: Bool[Array, ""], scenario: Scenario, state: State) -> State:
    """The state an episode goes on from: a fresh one where it has ended."""
    fresh = initial_state(scenario.params, scenario.layout)
    return jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, state)


def observe_as_paper(params: Params, layout: Layout, state: State) -> Float[Array, "*b two_n"]:
    """:func:`observe`, called as every way to see is."""
    return observe(layout, state)


@dataclass(frozen=True)
class UavMecEnv:
    """UAV-assisted edge computing as an environment with the signatures of gymnax 1.0.

    Observation: f32 ``[2n]``, see :func:`observe`. Action: int in ``[0, n)``, the device to visit.
    Reward: see :mod:`uavmec_jax.world.rewards`. ``params`` is a :class:`Scenario`, batched by ``vmap``.
    The state is a :class:`State`; ``step`` resets by itself when an episode ends and then reports the true last
    observation as ``info["final_observation"]``.

    Attributes:
        see: ``(params, layout, state) -> observation``, an array or a pytree; by default the paper's.
            :func:`uavmec_jax.observe_devices` is the full one.
    """

    see: Callable[[Params, Layout, State], Any] = observe_as_paper
    name: ClassVar[str] = "UavMec"

    @property
    def default_params(self) -> Scenario:
        """The scenario used where none is given: :func:`make_scenario` without arguments."""
        return make_scenario()

    def num_actions(self, params: Scenario) -> int:
        """Number of actions, one per device."""
        return params.layout.capacity.shape[-1]

    def observation_shape(self, params: Scenario) -> Any:
        """Shape of an observation; of one that is a pytree, the tree of its leaves' shapes."""
        state = jax.eval_shape(initial_state, params.params, params.layout)
        return jax.tree.map(lambda leaf: leaf.shape, jax.eval_shape(self.see, params.params, params.layout, state))

    @partial(jax.jit, static_argnames=("self",))
    def reset(self, key: PRNGKeyArray, params: Scenario | None = None) -> tuple[Any, State]:
        """Start an episode: observation and state. Nothing in it is random; volumes are drawn per slot."""
        del key
        scenario = self.default_params if params is None else params
        state = initial_state(scenario.params, scenario.layout)
        return self._seen(scenario, state), state

    @partial(jax.jit, static_argnames=("self",))
    def step(
        self, key: PRNGKeyArray, state: State, action: Any, params: Scenario | None = None
    ) -> tuple[Any, State, Array, Array, Array, dict[str, Any]]:
        """Play one slot with volumes drawn from ``key``.

        Returns:
            ``(observation, state, reward, terminated, truncated, info)``; ``info`` holds ``terminated``, ``truncated``,
            ``final_observation`` ``[2n]``, ``cause`` (:class:`Cause`), ``failed`` ``[n]``, ``served`` ``[n]``,
            ``duration`` (s), ``first_failure`` ``[n]`` and ``length`` (slots of the episode so far).
        """
        scenario = self.default_params if params is None else params
        layout = scenario.layout
        volumes = draw_volumes(scenario.params, jax.random.uniform(key, layout.capacity.shape))
        after, reward, outcome = advance(scenario, state, jnp.asarray(action, jnp.int32), volumes)
        terminated = outcome.cause != Cause.NONE
        truncated = is_truncated(scenario, after, outcome)
        final_observation = self._seen(scenario, after)
        next_state = restart_if(terminated | truncated, scenario, after)
        info = {
            "terminated": terminated,
            "truncated": truncated,
            "final_observation": final_observation,
            "cause": outcome.cause,
            "failed": outcome.failed,
            "served": outcome.served,
            "duration": outcome.duration,
            "first_failure": outcome.first_failure,
            "length": after.slot,
        }
        return self._seen(scenario, next_state), next_state, reward, terminated, truncated, info

    def _seen(self, scenario: Scenario, state: State) -> Any:
        return self.see(scenario.params, scenario.layout, state)

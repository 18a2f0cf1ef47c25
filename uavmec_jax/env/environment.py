"""The environment for reinforcement learning, with the signatures of gymnax 1.0."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial, wraps
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from uavmec_jax.env import gymnax_spaces
from uavmec_jax.env.checks import settled
from uavmec_jax.env.dynamics import Cause, State, fresh_state
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.observation import observe
from uavmec_jax.env.params import Params
from uavmec_jax.env.scenario import Scenario, advance, auto_reset, draw_volumes, is_truncated, make_scenario
from uavmec_jax.env.scenario_checks import check_scenario
from uavmec_jax.env.slot_checks import check_action


def _checks_scenario(reset: Callable) -> Callable:
    """Return ``reset``, a compiled method, behind a check of the scenario."""

    @wraps(reset)
    def checked(self: "UavMecEnv", key: PRNGKeyArray, params: Scenario | None = None) -> Any:
        if params is not None and not isinstance(params.layout.capacity, jax.core.Tracer):
            check_scenario(params.params, params.layout)
        return settled(reset(self, key, params))

    return checked


def _checks_action(step: Callable) -> Callable:
    """Return ``step``, a compiled method, behind a check of the action."""

    @wraps(step)
    def checked(self: "UavMecEnv", key: Any, state: State, action: Any, params: Scenario | None = None) -> Any:
        check_action(action, Params.n_devices if params is None else params.layout.n_places)
        return settled(step(self, key, state, action, params))

    return checked


@dataclass(
    unsafe_hash=True
)  # not frozen: gymnax's wrapper for Gymnasium's vector environments replaces methods of a copy
class UavMecEnv:
    """UAV-assisted edge computing with the signatures of gymnax 1.0; its wrappers run on it.

    - Observation: f32 ``[2n]``, see :func:`observe`.
    - Action: int32, a place for each UAV: a device in ``[0, n)`` or a depot in ``[n, n + D)``; shape ``[K]``, or ``[]`` if
      there is one UAV.
    - Reward: f32 scalar, see :mod:`uavmec_jax.env.rewards`.
    - State: a :class:`State`.
    - ``params``: a :class:`Scenario`; ``vmap`` batches it.

    ``step`` resets automatically when an episode ends; ``info["final_observation"]`` is the observation before the reset.

    Attributes:
        observation_fn: ``(params, layout, state) -> observation``, an array or a pytree. The default is the paper's
            observation; :func:`um.planning.observe_devices` is the full one.
    """

    observation_fn: Callable[[Params, Layout, State], Any] = observe
    name: ClassVar[str] = "UavMec"

    @property
    def default_params(self) -> Scenario:
        """The scenario used if none is given: :func:`make_scenario` without arguments."""
        return make_scenario()

    @property
    def num_actions(self) -> int:
        """Number of places that a UAV can fly to in :attr:`default_params`; ``action_space(params).n`` is that of others."""
        return Params.n_devices

    def action_space(self, params: Scenario | None = None) -> Any:
        """Return gymnax's ``Discrete`` of the places that a UAV can fly to, devices and depots; for a fleet, a ``Tuple``.

        Raises:
            UserError: gymnax is not installed.
        """
        return gymnax_spaces.action_space((self.default_params if params is None else params).layout)

    def observation_space(self, params: Scenario | None = None) -> Any:
        """Return gymnax's ``Box`` of the paper's observation ``[2n]``; of another ``observation_fn``, a space without bounds.

        Raises:
            UserError: gymnax is not installed.
        """
        scenario = self.default_params if params is None else params
        if self.observation_fn is observe:
            return gymnax_spaces.paper_observation_space(scenario.params, scenario.layout)
        state = jax.eval_shape(fresh_state, scenario.params, scenario.layout)
        return gymnax_spaces.unbounded_space(
            jax.eval_shape(self.observation_fn, scenario.params, scenario.layout, state)
        )

    @_checks_scenario
    @partial(jax.jit, static_argnames=("self",))
    def reset(self, key: PRNGKeyArray, params: Scenario | None = None) -> tuple[Any, State]:
        """Start an episode and return its observation and state. Nothing is drawn here: volumes are drawn in each slot.

        Raises:
            ArgumentError: a value of the scenario is out of range; one line. Traced values are not checked.
        """
        del key
        scenario = self.default_params if params is None else params
        state = fresh_state(scenario.params, scenario.layout)
        return self._observe(scenario, state), state

    @_checks_action
    @partial(jax.jit, static_argnames=("self",))
    def step(
        self,
        key: PRNGKeyArray,
        state: State,
        action: Int[ArrayLike, ""] | Int[Array, " K"],
        params: Scenario | None = None,
    ) -> tuple[Any, State, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], dict[str, Any]]:
        """Play one slot with volumes drawn from ``key``.

        Returns:
            ``(observation, state, reward, terminated, truncated, info)``; ``info`` holds ``terminated``, ``truncated``,
            ``final_observation``, the fields of :class:`Outcome` and ``length``, the slots of the episode so far.

        Raises:
            ArgumentError: the action is out of range; one line. A traced action is clamped, see :func:`um.debug_checks`.
        """
        scenario = self.default_params if params is None else params
        layout = scenario.layout
        volumes = draw_volumes(scenario.params, jax.random.uniform(key, layout.capacity.shape))
        after, reward, outcome = advance(scenario, state, jnp.asarray(action, jnp.int32), volumes)
        terminated = outcome.cause != Cause.NONE
        truncated = is_truncated(scenario, after, outcome)
        final_observation = self._observe(scenario, after)
        next_state = auto_reset(terminated | truncated, scenario, state, after)
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
        return self._observe(scenario, next_state), next_state, reward, terminated, truncated, info

    def _observe(self, scenario: Scenario, state: State) -> Any:
        return self.observation_fn(scenario.params, scenario.layout, state)

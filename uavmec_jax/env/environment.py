"""The environment a learner sees: scenarios, observations, and the signatures of gymnax 1.0."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from uavmec_jax.env.dynamics import Cause, State, initial_state
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.observation import observe_as_paper
from uavmec_jax.env.params import Params
from uavmec_jax.env.scenario import Scenario, advance, auto_reset, draw_volumes, is_truncated, make_scenario


@dataclass(frozen=True)
class UavMecEnv:
    """UAV-assisted edge computing as an environment with the signatures of gymnax 1.0.

    Observation: f32 ``[2n]``, see :func:`observe`. Action: int in ``[0, n)``, the device to visit.
    Reward: see :mod:`uavmec_jax.env.rewards`. ``params`` is a :class:`Scenario`, batched by ``vmap``.
    The state is a :class:`State`; ``step`` resets by itself when an episode ends and then reports the true last
    observation as ``info["final_observation"]``.

    Attributes:
        observation_fn: ``(params, layout, state) -> observation``, an array or a pytree; by default the paper's.
            :func:`um.planning.observe_devices` is the full one.
    """

    observation_fn: Callable[[Params, Layout, State], Any] = observe_as_paper
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
        return jax.tree.map(
            lambda leaf: leaf.shape, jax.eval_shape(self.observation_fn, params.params, params.layout, state)
        )

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
        next_state = auto_reset(terminated | truncated, scenario, after)
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
        return self.observation_fn(scenario.params, scenario.layout, state)

"""One scenario as a Gymnasium environment, for libraries that step one environment from Python."""

from functools import partial
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from uavmec_jax.env.dynamics import Cause, State, initial_state
from uavmec_jax.env.layout import check_one_uav
from uavmec_jax.env.observation import observe
from uavmec_jax.env.scenario import Scenario, advance, draw_volumes, is_truncated, make_scenario
from uavmec_jax.env.slot_checks import check_action


def make_spaces(scenario: Scenario) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Discrete]:
    """Return the spaces of observations and actions of a scenario, or of one of a batch.

    Observations are ``[2n]``: n battery fractions in [0, 1], then n data ages from 0 to the limit + 1. The action is the
    device to visit. Where an episode goes on after a failure, ages have no limit.

    Raises:
        ValueError: the layout has several UAVs or depots.
    """
    check_one_uav(scenario.layout, "this interface")
    n = scenario.layout.capacity.shape[-1]
    max_age = float(np.max(scenario.params.data_age_limit_slots)) + 1.0
    if scenario.params.end == "horizon":
        max_age = np.inf
    high = np.concatenate([np.ones(n, np.float32), np.full(n, max_age, np.float32)])
    return gymnasium.spaces.Box(np.zeros(2 * n, np.float32), high, dtype=np.float32), gymnasium.spaces.Discrete(n)


class UavMecGymEnv(gymnasium.Env):
    """The environment on one scenario.

    ``reset(seed=...)`` seeds the task volumes, which are all that is random. ``info`` holds ``cause`` (``"none"``,
    ``"battery"``, ``"data_age"``, ``"uav"``), ``failed`` and ``served`` (``[n]`` bool), ``first_failure`` (``[n]``, shares),
    ``duration`` (s) and ``length`` (slots of the episode so far).
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012

    def __init__(self, scenario: Scenario | None = None, render_mode: str | None = None) -> None:
        """Bind a scenario.

        Args:
            scenario: by default that of :func:`um.make_scenario`.
            render_mode: ``None`` or ``"rgb_array"``.

        Raises:
            ValueError: the render mode is another one, the layout has several UAVs or depots, or a value of the scenario is
                out of range.
        """
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode is {render_mode!r}; it should be None or 'rgb_array'")
        self.scenario = make_scenario() if scenario is None else scenario
        self.render_mode = render_mode
        self.observation_space, self.action_space = make_spaces(self.scenario)
        self._n = int(self.scenario.layout.capacity.shape[0])
        self._initial_state = jax.device_get(initial_state(self.scenario.params, self.scenario.layout))
        self._initial_observation = np.asarray(observe(self.scenario.params, self.scenario.layout, self._initial_state))
        self._play_slot = jax.jit(partial(_play_slot, self.scenario))
        self._state = self._initial_state
        self._last_action: int | None = None

    def reset(
        self, *, seed: int | None = None, options: dict | None = None
    ) -> tuple[Float[np.ndarray, " two_n"], dict[str, Any]]:
        """Start an episode: full batteries, fresh data, the UAV in the origin corner."""
        super().reset(seed=seed, options=options)
        self._state, self._last_action = self._initial_state, None
        return self._initial_observation.copy(), {}

    def step(self, action: Any) -> tuple[Float[np.ndarray, " two_n"], float, bool, bool, dict[str, Any]]:
        """Visit the device ``action``, with task volumes drawn from the environment's generator.

        Raises:
            ArgumentError: there is no such device; one line.
        """
        check_action(action, self._n)
        uniform = self.np_random.random(self._n, dtype=np.float32)
        self._state, packed = self._play_slot(self._state, np.int32(action), uniform)
        self._last_action = int(action)
        scalars, observation, per_device = np.split(np.asarray(packed), [5, 5 + 2 * self._n])
        reward, cause, truncated, duration, length = scalars
        failed, served, first_failure = per_device.reshape(3, self._n)
        info = {
            "cause": Cause(int(cause)).name.lower(),
            "failed": failed > 0,
            "served": served > 0,
            "first_failure": first_failure,
            "duration": float(duration),
            "length": int(length),
        }
        return observation, float(reward), bool(cause != Cause.NONE), bool(truncated), info

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """Return the map as pixels: the UAV, and devices with batteries and ages; ``None`` without a render mode."""
        if self.render_mode is None:
            return None
        # A training never renders, and importing matplotlib takes longer than everything else here.
        from uavmec_jax.reporting.map_figure import map_pixels

        return map_pixels(self.scenario, jax.device_get(self._state), self._last_action)


def _play_slot(
    scenario: Scenario, state: State, action: Int[Array, ""], uniform: Float[Array, " n"]
) -> tuple[State, Float[Array, " packed"]]:
    """Play one slot; all results but the state are packed into one array, so that they cross from the device at once.

    Returns:
        The state, and ``[5 + 5n]``: reward, cause, truncated, duration, slot; the observation ``[2n]``; failed, served and
        first failure, each ``[n]``.
    """
    after, reward, outcome = advance(scenario, state, action, draw_volumes(scenario.params, uniform))
    truncated = is_truncated(scenario, after, outcome)
    scalars = jnp.stack([reward, outcome.cause, truncated, outcome.duration, after.slot])
    observation = observe(scenario.params, scenario.layout, after)
    parts = [scalars, observation, outcome.failed, outcome.served, outcome.first_failure]
    return after, jnp.concatenate([part.astype(jnp.float32) for part in parts])

"""One scenario as a Gymnasium environment, for learners that step one environment from Python."""

from functools import partial
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from uavmec_jax.env.dynamics import Cause, State, initial_state
from uavmec_jax.env.observation import observe
from uavmec_jax.env.scenario import Scenario, advance, draw_volumes, is_truncated, make_scenario


def spaces(scenario: Scenario) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Discrete]:
    """Observations: n battery fractions in [0, 1], then n ages from 0 to the limit + 1. Actions: the device to visit."""
    n = scenario.layout.capacity.shape[-1]
    oldest = float(np.max(scenario.params.data_age_limit_slots)) + 1.0
    highest = np.concatenate([np.ones(n, np.float32), np.full(n, oldest, np.float32)])
    return gymnasium.spaces.Box(np.zeros(2 * n, np.float32), highest, dtype=np.float32), gymnasium.spaces.Discrete(n)


class UavMecGymEnv(gymnasium.Env):
    """The environment on one layout.

    ``reset(seed=...)`` seeds the task volumes, the only thing that is random. ``info`` holds ``cause`` (``"none"``,
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
            ValueError: another render mode.
        """
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode is {render_mode!r}; it should be None or 'rgb_array'")
        self.scenario = make_scenario() if scenario is None else scenario
        self.render_mode = render_mode
        self.observation_space, self.action_space = spaces(self.scenario)
        self._n = int(self.scenario.layout.capacity.shape[0])
        self._start = jax.device_get(initial_state(self.scenario.params, self.scenario.layout))
        self._first = np.asarray(observe(self.scenario.params, self.scenario.layout, self._start))
        self._play = jax.jit(partial(_play, self.scenario))
        self._state = self._start
        self._visited: int | None = None

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode: full batteries, fresh data, the UAV in the origin corner."""
        super().reset(seed=seed, options=options)
        self._state, self._visited = self._start, None
        return self._first.copy(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Visit the device ``action``, with volumes drawn from the environment's generator."""
        uniform = self.np_random.random(self._n, dtype=np.float32)
        self._state, packed = self._play(self._state, np.int32(action), uniform)
        self._visited = int(action)
        numbers = np.asarray(packed)
        n = self._n
        failed, served, first_failure = numbers[5 + 2 * n :].reshape(3, n)
        info = {
            "cause": Cause(int(numbers[1])).name.lower(),
            "failed": failed > 0,
            "served": served > 0,
            "first_failure": first_failure,
            "duration": float(numbers[3]),
            "length": int(numbers[4]),
        }
        return numbers[5 : 5 + 2 * n], float(numbers[0]), bool(numbers[1]), bool(numbers[2]), info

    def render(self) -> np.ndarray | None:
        """The map as ``[height, width, 3]`` uint8: UAV, devices with batteries and ages; ``None`` without a mode."""
        if self.render_mode is None:
            return None
        from uavmec_jax.reporting.map_figure import map_pixels

        return map_pixels(self.scenario, jax.device_get(self._state), self._visited)


def _play(scenario: Scenario, state: State, action: Any, uniform: Any) -> tuple[State, Any]:
    """One slot; everything NumPy wants in one array, so that it crosses from the device once."""
    after, reward, outcome = advance(scenario, state, action, draw_volumes(scenario.params, uniform))
    truncated = is_truncated(scenario, after, outcome)
    numbers = jnp.stack([reward, outcome.cause, truncated, outcome.duration, after.slot])
    observation = observe(scenario.params, scenario.layout, after)
    parts = [numbers, observation, outcome.failed, outcome.served, outcome.first_failure]
    return after, jnp.concatenate([part.astype(jnp.float32) for part in parts])

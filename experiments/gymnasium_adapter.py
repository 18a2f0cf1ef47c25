"""One scenario as a Gymnasium environment, for learners that step one environment from Python."""

from functools import partial
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from uavmec_jax.world.environment import Scenario, advance, draw_volumes, is_truncated, observe
from uavmec_jax.world.physics import Cause, State, initial_state


class SingleScenario(gymnasium.Env):
    """The environment on one layout: observation f32 ``[2n]``, actions ``0..n-1``, volumes from NumPy's generator."""

    def __init__(self, scenario: Scenario) -> None:
        n = scenario.layout.capacity.shape[0]
        highest = np.concatenate([np.ones(n), np.full(n, float(scenario.params.data_age_limit_slots) + 1)])
        self.observation_space = gymnasium.spaces.Box(0.0, highest.astype(np.float32), dtype=np.float32)
        self.action_space = gymnasium.spaces.Discrete(n)
        self._start = initial_state(scenario.params, scenario.layout)
        self._first = np.asarray(observe(scenario.layout, self._start))
        self._play = jax.jit(partial(_play, scenario))
        self._state = self._start

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self._state = self._start
        return self._first.copy(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        uniform = self.np_random.random(self.action_space.n, dtype=np.float32)
        self._state, numbers = self._play(self._state, np.int32(action), uniform)
        numbers = np.asarray(numbers)
        return numbers[3:], float(numbers[0]), bool(numbers[1]), bool(numbers[2]), {}


def _play(scenario: Scenario, state: State, action: Any, uniform: Any) -> tuple[State, Any]:
    """One slot; everything NumPy wants in one array, so that it crosses from the device once."""
    after, reward, outcome = advance(scenario, state, action, draw_volumes(scenario.params, uniform))
    truncated = is_truncated(scenario, after, outcome)
    flags = jnp.stack([reward, (outcome.cause != Cause.NONE).astype(jnp.float32), truncated.astype(jnp.float32)])
    return after, jnp.concatenate([flags, observe(scenario.layout, after)])

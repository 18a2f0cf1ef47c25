"""One scenario as a Gymnasium environment, for libraries that step one environment from Python."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from uavmec_jax.agents.observation_spec import OBSERVATIONS
from uavmec_jax.env.dynamics import Cause, State, initial_state
from uavmec_jax.env.rewards import Reward
from uavmec_jax.env.scenario import Scenario, advance, draw_volumes, is_truncated
from uavmec_jax.env.slot_checks import check_action
from uavmec_jax.errors import UserError
from uavmec_jax.interop.options import choose_scenario, choose_spaces


class UavMecGymEnv(gymnasium.Env):
    """The environment on one scenario. It can be pickled, also in the middle of an episode.

    ``reset(seed=...)`` seeds the task volumes, which are all that is random. ``info`` holds ``cause`` (``"none"``,
    ``"battery"``, ``"data_age"``, ``"uav"``), ``failed`` and ``served`` (``[n]`` bool), ``first_failure`` (``[n]``, shares),
    ``duration`` (s) and ``length`` (slots of the episode so far).
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012

    _jax_process: ClassVar[int | None] = None
    """The process in which an environment first used JAX."""

    def __init__(
        self,
        scenario: Scenario | str | Path | None = None,
        render_mode: str | None = None,
        *,
        observation: str = "paper",
        reward: str | Reward | None = None,
        powered: int | None = None,
        connected: int | None = None,
        layout_seed: int | None = None,
    ) -> None:
        """Make the scenario.

        Args:
            scenario: a scenario or a scenario file; by default a random layout of the paper's twelve devices.
            render_mode: ``None`` or ``"rgb_array"``.
            observation: ``"paper"``, ``[2n]``, or ``"full"``, ``[n * (F + 1)]``.
            reward: a name of Table 6, or what :func:`um.make_reward` returns; by default that of the scenario.
            powered: number of devices with power in a random layout; by default 8.
            connected: number of devices with communication in a random layout; by default 8.
            layout_seed: seed of the random layout; by default 0.

        Raises:
            ValueError: the render mode is another one, the layout has several UAVs or depots, or an option or a value of the
                scenario is out of range.
            UserError: this process is a fork of one that has used JAX.
        """
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode is {render_mode!r}; it should be None or 'rgb_array'")
        self._check_process()
        self.scenario = choose_scenario(scenario, powered, connected, layout_seed, reward)
        self.render_mode, self.observation = render_mode, observation
        self.observation_space, self.action_space = choose_spaces(self.scenario, observation)
        self._compile()
        self._state = self._initial_state
        self._last_action: int | None = None

    def _compile(self) -> None:
        """Make what follows from the scenario and the observation, and is not pickled."""
        observe = OBSERVATIONS[self.observation].observation_fn
        params, layout = self.scenario.params, self.scenario.layout
        state = initial_state(params, layout)
        self._initial_state = jax.device_get(state)
        self._initial_observation = np.asarray(observe(params, layout, state))
        self._play_slot = jax.jit(partial(_play_slot, self.scenario, observe))

    def _check_process(self) -> None:
        """Refuse to work in a fork of a process that has used JAX, whose threads are not in the fork: it would wait for ever.

        Raises:
            UserError: it is one; the line says what to do.
        """
        if UavMecGymEnv._jax_process not in (None, os.getpid()):
            raise UserError(
                "this process was forked from one that has used JAX, which cannot work in it; start processes another way: "
                "make_vec(..., vectorization_mode='async', vector_kwargs={'context': 'spawn'}), or, which is faster, leave "
                "vectorization_mode out: all environments are then one jitted call"
            )
        UavMecGymEnv._jax_process = os.getpid()

    def __getstate__(self) -> dict[str, Any]:
        """Return what to pickle: all but what :meth:`_compile` makes, arrays as NumPy's."""
        made = ("_initial_state", "_initial_observation", "_play_slot")
        kept = {name: value for name, value in self.__dict__.items() if name not in made}
        return kept | {"_state": jax.device_get(self._state)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Go on where the pickled environment was."""
        self._check_process()
        self.__dict__.update(state)
        self._compile()

    def reset(
        self, *, seed: int | None = None, options: dict | None = None
    ) -> tuple[Float[np.ndarray, " obs_size"], dict[str, Any]]:
        """Start an episode: full batteries, fresh data, the UAV in the origin corner.

        Raises:
            UserError: this process is a fork of one that has used JAX.
        """
        self._check_process()
        super().reset(seed=seed, options=options)
        self._state, self._last_action = self._initial_state, None
        return self._initial_observation.copy(), {}

    def step(self, action: Any) -> tuple[Float[np.ndarray, " obs_size"], float, bool, bool, dict[str, Any]]:
        """Visit the device ``action``, with task volumes drawn from the environment's generator.

        Raises:
            ArgumentError: there is no such device; one line.
        """
        n = self.scenario.layout.n_devices
        check_action(action, n)
        uniform = self.np_random.random(n, dtype=np.float32)
        self._state, packed = self._play_slot(self._state, np.int32(action), uniform)
        self._last_action = int(action)
        # A copy, since JAX's arrays cannot be written: what is returned is the caller's own.
        scalars, per_device, observation = np.split(np.array(packed), [5, 5 + 3 * n])
        reward, cause, truncated, duration, length = scalars.tolist()
        failed, served, first_failure = per_device.reshape(3, n)
        info = {
            "cause": Cause(int(cause)).name.lower(),
            "failed": failed > 0,
            "served": served > 0,
            "first_failure": first_failure,
            "duration": duration,
            "length": int(length),
        }
        return observation, reward, cause != Cause.NONE, bool(truncated), info

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """Return the map as pixels: the UAV, and devices with batteries and ages; ``None`` without a render mode."""
        if self.render_mode is None:
            return None
        # A training never renders, and importing matplotlib takes longer than everything else here.
        from uavmec_jax.reporting.map_figure import map_pixels

        return map_pixels(self.scenario, jax.device_get(self._state), self._last_action)


def _play_slot(
    scenario: Scenario, observe: Callable[..., Array], state: State, action: Int[Array, ""], uniform: Float[Array, " n"]
) -> tuple[State, Float[Array, " packed"]]:
    """Play one slot; all results but the state are packed into one array, so that they cross from the device at once.

    Returns:
        The state, and ``[5 + 3n + obs_size]``: reward, cause, truncated, duration, slot; failed, served and first failure,
        each ``[n]``; the observation.
    """
    after, reward, outcome = advance(scenario, state, action, draw_volumes(scenario.params, uniform))
    truncated = is_truncated(scenario, after, outcome)
    scalars = jnp.stack([reward, outcome.cause, truncated, outcome.duration, after.slot])
    observation = observe(scenario.params, scenario.layout, after)
    parts = [scalars, outcome.failed, outcome.served, outcome.first_failure, observation]
    return after, jnp.concatenate([part.astype(jnp.float32) for part in parts])

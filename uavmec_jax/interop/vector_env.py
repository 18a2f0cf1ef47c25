"""Many scenarios as one Gymnasium vector environment: every step is one jitted call."""

from functools import partial
from pathlib import Path
from typing import Any

import chex
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Array, Bool, Float, Int, Key

from uavmec_jax.agents.observation_spec import OBSERVATIONS
from uavmec_jax.env.checks import check_range
from uavmec_jax.env.dynamics import Cause, State
from uavmec_jax.env.environment import UavMecEnv
from uavmec_jax.env.rewards import Reward
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.env.scenario_checks import check_scenario
from uavmec_jax.env.slot_checks import check_action
from uavmec_jax.interop.options import choose_scenario, choose_spaces

_CAUSES = np.array([cause.name.lower() for cause in Cause])


class UavMecVectorEnv(VectorEnv):
    """``N`` scenarios stepped together; an episode that ends is reset in the same step.

    ``info`` holds arrays over the environments: ``cause`` ``[N]``, ``failed`` and ``served`` ``[N, n]`` bool,
    ``first_failure`` ``[N, n]``, ``duration`` and ``length`` ``[N]``. Where episodes ended, it also holds ``final_obs`` and
    ``final_info`` with the mask ``_final_obs``, as in Gymnasium's own vector environments.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Scenario | str | Path | None = None,
        *,
        observation: str = "paper",
        reward: str | Reward | None = None,
        powered: int | None = None,
        connected: int | None = None,
        layout_seed: int | None = None,
    ) -> None:
        """Make the scenarios.

        Args:
            num_envs: ``N``.
            scenario: a scenario or a scenario file for all environments, or one scenario each (leaves ``[N, ...]``); by
                default random layouts of the paper's twelve devices, all different.
            observation: ``"paper"`` or ``"full"``, as in :class:`UavMecGymEnv`.
            reward: a name of Table 6, or what :func:`um.make_reward` returns; by default that of the scenario.
            powered: number of devices with power in the random layouts; by default 8.
            connected: number of devices with communication in the random layouts; by default 8.
            layout_seed: seed of the first random layout, the others follow; by default 0.

        Raises:
            ValueError: the batch of scenarios has another size, or an option or a value is out of range.
        """
        check_range("num_envs", num_envs, ge=1, whole=True)
        self.num_envs = num_envs
        self._scenarios = choose_scenario(scenario, powered, connected, layout_seed, reward, batch=num_envs)
        check_scenario(self._scenarios.params, self._scenarios.layout)
        self.single_observation_space, self.single_action_space = choose_spaces(self._scenarios, observation)
        self.observation_space: gymnasium.Space = batch_space(self.single_observation_space, num_envs)
        self.action_space: gymnasium.Space = batch_space(self.single_action_space, num_envs)
        self._env = UavMecEnv(observation_fn=OBSERVATIONS[observation].observation_fn)
        self._state: State | None = None
        self._key, self._steps = jax.random.key(0), 0

    def reset(
        self, *, seed: int | None = None, options: dict | None = None
    ) -> tuple[Float[np.ndarray, "N obs_size"], dict[str, Any]]:
        """Start an episode in every environment; ``seed`` seeds the task volumes of all."""
        super().reset(seed=seed, options=options)
        if seed is not None or self._state is None:
            self._key, self._steps = jax.random.key(int(self.np_random.integers(2**32, dtype=np.uint32))), 0
        observation, self._state = _reset(self._env, self._scenarios)
        return np.array(observation), {}

    def step(
        self, actions: Any
    ) -> tuple[
        Float[np.ndarray, "N obs_size"],
        Float[np.ndarray, " N"],
        Bool[np.ndarray, " N"],
        Bool[np.ndarray, " N"],
        dict[str, Any],
    ]:
        """Play one slot in every environment; ``actions`` is ``[N]``.

        Raises:
            ArgumentError: there is no such device; one line that names the environment.
        """
        check_action(actions, self._scenarios.layout.n_devices, ("environment",))
        actions = jnp.asarray(actions, jnp.int32)
        observation, self._state, *results = _step(
            self._env, self._scenarios, self._key, np.uint32(self._steps), self._state, actions
        )
        self._steps += 1
        # Copies, since JAX's arrays cannot be written: what is returned is the caller's own.
        observation, (reward, terminated, truncated, info) = jax.tree.map(
            np.array, jax.device_get((observation, results))
        )
        final_observation = info.pop("final_observation")
        ended = info.pop("terminated") | info.pop("truncated")
        info["cause"] = _CAUSES[info["cause"]]
        if ended.any():
            final_obs = np.full(self.num_envs, None, dtype=object)
            for index in np.flatnonzero(ended):
                final_obs[index] = final_observation[index]
            masks = {f"_{name}": ended for name in info}
            final_info = dict(info) | masks
            info |= {"final_obs": final_obs, "_final_obs": ended, "final_info": final_info, "_final_info": ended}
        return observation, reward, terminated, truncated, info


@partial(jax.jit, static_argnums=0)
def _reset(env: UavMecEnv, scenarios: Scenario) -> tuple[Float[Array, "N obs_size"], State]:
    return jax.vmap(lambda scenario: env.reset(jax.random.key(0), scenario))(scenarios)


@partial(jax.jit, static_argnums=0)
def _step(
    env: UavMecEnv, scenarios: Scenario, key: Key[Array, ""], number: Any, state: State, actions: Int[Array, " N"]
) -> Any:
    """Play step ``number`` of every environment."""
    chex.assert_equal_shape((actions, state.slot))
    keys = jax.random.split(jax.random.fold_in(key, number), actions.shape[0])
    return jax.vmap(env.step)(keys, state, actions, scenarios)

"""Many scenarios as one Stable-Baselines3 ``VecEnv``: every step is one jitted call."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from uavmec_jax.interop.vector_env import UavMecVectorEnv


class UavMecSB3VecEnv(VecEnv):
    """``N`` scenarios stepped together, for ``PPO("MlpPolicy", UavMecSB3VecEnv(64))``.

    An episode that ends is reset in the same step. ``infos`` holds a dictionary for each environment, which is empty but for
    those whose episode ended: ``terminal_observation``, ``TimeLimit.truncated``, ``cause``, ``length`` (slots) and
    ``episode``, with its return ``r`` and its length ``l``, which Stable-Baselines3 logs.
    """

    def __init__(self, num_envs: int = 1, **options: Any) -> None:
        """Make the scenarios.

        Args:
            num_envs: ``N``.
            options: those of :class:`UavMecVectorEnv`: ``scenario``, ``observation``, ``reward``, ``powered``, ``connected``
                and ``layout_seed``.

        Raises:
            ValueError: the batch of scenarios has another size, or an option or a value is out of range.
        """
        self.vector_env = UavMecVectorEnv(num_envs, **options)
        super().__init__(num_envs, self.vector_env.single_observation_space, self.vector_env.single_action_space)
        self._actions = np.zeros(num_envs, int)
        self._returns = np.zeros(num_envs)

    def reset(self) -> Float[np.ndarray, "N obs_size"]:
        """Start an episode in every environment; the seed of the first one, see ``seed``, seeds the task volumes of all."""
        observation, _ = self.vector_env.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0.0
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions ``[N]`` for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Play one slot in every environment.

        Raises:
            ArgumentError: there is no such device; one line that names the environment.
        """
        observation, reward, terminated, truncated, info = self.vector_env.step(self._actions)
        self._returns += reward
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done):
            length = int(info["length"][index])
            infos[index] = {
                "terminal_observation": info["final_obs"][index],
                "TimeLimit.truncated": bool(truncated[index]),
                "cause": str(info["cause"][index]),
                "length": length,
                "episode": {"r": float(self._returns[index]), "l": length, "t": 0.0},
            }
        self._returns[done] = 0.0
        return observation, reward, done, infos

    def close(self) -> None:
        """Do nothing: there are no processes to end."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the vector environment, which all environments have in common, once for each."""
        return [getattr(self.vector_env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: environments that are stepped together cannot differ in an attribute.

        Raises:
            AttributeError: always.
        """
        raise AttributeError(f"{attr_name} cannot be set in environments that are stepped together")

    def env_method(self, method_name: str, *arguments: Any, indices: Any = None, **options: Any) -> list[Any]:
        """Refuse: there is no environment whose method could be called.

        Raises:
            AttributeError: always.
        """
        raise AttributeError(
            f"{method_name} cannot be called: the environments are stepped together, none exists by itself"
        )

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return ``False`` for each: there are no wrappers within."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[None]:
        """Return no images."""
        return [None] * self.num_envs

"""The environment for libraries that still speak the step of gymnax 0.0.9: five values, one ``done``."""

from typing import Any

import jax
from flax import struct
from jaxtyping import Array, PRNGKeyArray

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.environment import UavMecEnv
from uavmec_jax.env.scenario import Scenario, make_scenario


@struct.dataclass
class FiveValueParams:
    """What such libraries look for in an environment's parameters.

    Attributes:
        scenario: what is played.
        max_steps_in_episode: int, as an evaluation counts.
    """

    scenario: Scenario
    max_steps_in_episode: Any = struct.field(pytree_node=False, default=1000)


class FiveValueEnv:
    """:class:`UavMecEnv` with ``step`` returning ``(observation, state, reward, done, info)``.

    Truncation counts as done; ``info["discount"]`` is 0 where the episode terminated.
    """

    name = "UavMec"

    def __init__(self) -> None:
        """Wrap the environment."""
        self._env = UavMecEnv()

    @property
    def default_params(self) -> FiveValueParams:
        """The scenario of :func:`um.make_scenario`."""
        return FiveValueParams(scenario=make_scenario())

    def reset(self, key: PRNGKeyArray, params: FiveValueParams | None = None) -> tuple[Array, State]:
        """Start an episode."""
        return self._env.reset(key, (params or self.default_params).scenario)

    def step(
        self, key: PRNGKeyArray, state: State, action: Any, params: FiveValueParams | None = None
    ) -> tuple[Array, State, Array, Array, dict[str, Array]]:
        """Play one slot."""
        scenario = (params or self.default_params).scenario
        observation, state, reward, terminated, truncated, info = self._env.step(key, state, action, scenario)
        return observation, state, reward, terminated | truncated, info | {"discount": 1.0 - terminated}

    def observation_space(self, params: FiveValueParams) -> Any:
        """gymnax's ``Box``."""
        from gymnax.environments import spaces

        oldest = params.scenario.params.data_age_limit_slots + 1.0
        return spaces.Box(0.0, oldest, self._env.observation_shape(params.scenario), jax.numpy.float32)

    def action_space(self, params: FiveValueParams | None = None) -> Any:
        """gymnax's ``Discrete``."""
        from gymnax.environments import spaces

        return spaces.Discrete(self._env.num_actions((params or self.default_params).scenario))

"""The environment for libraries that still expect the step of gymnax 0.0.9: five values, one ``done``."""

from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Num, PRNGKeyArray

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.environment import UavMecEnv
from uavmec_jax.env.layout import check_one_uav
from uavmec_jax.env.scenario import Scenario, make_scenario


@struct.dataclass
class FiveValueParams:
    """Environment parameters with the attributes that such libraries read.

    Attributes:
        scenario: the scenario that is played.
        max_steps_in_episode: length to which such libraries cut their evaluation episodes; static.
    """

    scenario: Scenario
    max_steps_in_episode: int = struct.field(pytree_node=False, default=1000)


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

    def reset(self, key: PRNGKeyArray, params: FiveValueParams | None = None) -> tuple[Float[Array, " two_n"], State]:
        """Start an episode; return the observation ``[2n]`` and the state."""
        return self._env.reset(key, (params or self.default_params).scenario)

    def step(
        self, key: PRNGKeyArray, state: State, action: Num[ArrayLike, ""], params: FiveValueParams | None = None
    ) -> tuple[Float[Array, " two_n"], State, Float[Array, ""], Bool[Array, ""], dict[str, Array]]:
        """Play one slot, with an automatic reset at the end of an episode.

        Raises:
            ArgumentError: there is no such device; one line. A traced action is clamped.
        """
        scenario = (params or self.default_params).scenario
        observation, state, reward, terminated, truncated, info = self._env.step(key, state, action, scenario)
        return observation, state, reward, terminated | truncated, info | {"discount": 1.0 - terminated}

    def observation_space(self, params: FiveValueParams) -> Any:
        """Return gymnax's ``Box`` from 0 to the data age limit + 1."""
        from gymnax.environments import spaces  # not a dependency: only clients of gymnax call this

        max_age = params.scenario.params.data_age_limit_slots + 1.0
        return spaces.Box(0.0, max_age, self._env.observation_shape(params.scenario), jnp.float32)

    def action_space(self, params: FiveValueParams | None = None) -> Any:
        """Return gymnax's ``Discrete``: the device to visit."""
        from gymnax.environments import spaces

        scenario = (params or self.default_params).scenario
        check_one_uav(scenario.layout, "this interface")
        return spaces.Discrete(self._env.num_actions(scenario))

"""The environment for libraries that still expect the step of gymnax 0.0.9: five values, one ``done``."""

from typing import Any

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

    Truncation counts as done. ``info`` holds scalars alone, since such libraries average whatever is in it: ``discount``,
    which is 0 where the episode terminated, ``terminated``, ``truncated``, ``cause``, ``duration`` (s) and ``length``.
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
        scalars = {name: info[name] for name in ("terminated", "truncated", "cause", "duration", "length")}
        return observation, state, reward, terminated | truncated, scalars | {"discount": 1.0 - terminated}

    @property
    def num_actions(self) -> int:
        """As :attr:`um.UavMecEnv.num_actions`."""
        return self._env.num_actions

    def observation_space(self, params: FiveValueParams | None = None) -> Any:
        """Return gymnax's ``Box`` of the observation ``[2n]``.

        Raises:
            UserError: gymnax is not installed.
        """
        return self._env.observation_space((params or self.default_params).scenario)

    def action_space(self, params: FiveValueParams | None = None) -> Any:
        """Return gymnax's ``Discrete``: the device to visit.

        Raises:
            ValueError: the layout has several UAVs or depots.
            UserError: gymnax is not installed.
        """
        scenario = (params or self.default_params).scenario
        check_one_uav(scenario.layout, "this interface")
        return self._env.action_space(scenario)

"""Study files: what may stand in one, and one clear line for whatever may not.

The numbers of Table 1 and the hyperparameters are declared once, as pytrees (:class:`Params`, :class:`DQNHyper`,
:class:`DQNSpec`); the checks of a study file are made from those declarations.
"""

import dataclasses
from typing import Annotated, Any, Literal, get_args

import pydantic
from pydantic import Field

from uavmec_jax.learning.dqn import DQNHyper, DQNSpec
from uavmec_jax.planning.beam import WIDTH as BEAM_WIDTH
from uavmec_jax.planning.lookahead import SAMPLES as ROLLOUT_SAMPLES
from uavmec_jax.world.params import Params
from uavmec_jax.world.rewards import DEFAULT_REWARD, LOG_GUARDS, REWARDS, TERMS
from uavmec_jax.world.settings import ParamsSettings, Strict, check_ranges, nearest, settings_model, wanted

DQNSettings: Any = settings_model("DQNSettings", DQNHyper, DQNSpec, leave_out=("total_steps", "n_devices", "max_age"))

TRACED = tuple(field.name for field in dataclasses.fields(DQNHyper))
"""Hyperparameters that may be axes of a study."""

TRACED_PARAMS = tuple(field.name for field in dataclasses.fields(Params) if isinstance(field.default, int | float))
TRACED_PARAMS = tuple(name for name in TRACED_PARAMS if name != "n_devices")
"""Scenario parameters that may be axes of a study."""

Heuristic = Literal[
    "stay-put",
    "random",
    "round-robin",
    "oldest-first",
    "lowest-battery",
    "shortest-life",
    "shortest-tour",
    "earliest-deadline",
]

Planner = Literal["rollout", "beam", "bound"]
PLANNERS: tuple[Planner, ...] = get_args(Planner)
"""From what a UAV can do to what nobody can pass."""


class Evaluation(Strict):
    """How policies are judged."""

    draws: Annotated[int, Field(ge=1, le=10_000)] = 32
    """Held-out volume draws per agent; one fixed draw, the same for every agent, is played besides."""
    validate_every: Annotated[int, Field(ge=1)] = 10_000
    """Environment steps of one agent between looks at the greedy policy."""
    validation_draws: Annotated[int, Field(ge=1, le=1000)] = 16
    baselines: tuple[Heuristic, ...] = get_args(Heuristic)
    """Heuristics that play the same draws as the trained policies."""
    planners: tuple[Planner, ...] = PLANNERS
    """What says how far from the best possible the policies are; see ``docs/planning.md``."""
    planner_draws: Annotated[int, Field(ge=1, le=10_000)] = 8
    """The planners play the first of the held-out draws, this many (all of them if there are fewer)."""
    rollout_samples: Annotated[int, Field(ge=1, le=1000)] = ROLLOUT_SAMPLES
    beam_width: Annotated[int, Field(ge=1, le=100_000)] = BEAM_WIDTH


class Study(Strict):
    """One study: the product of its axes is the population."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=80)] = "study"
    description: str = ""
    algorithm: Literal["dqn", "none"] = "dqn"
    """``none`` trains nothing: heuristics and planners alone."""
    reward: str | dict[str, float] = DEFAULT_REWARD
    guard: Literal["clamp", "log1p"] = "clamp"
    steps: Annotated[int, Field(ge=1, le=2_000_000_000)] = 1_000_000
    """Environment steps of one agent."""
    axes: dict[str, Any]
    """``powered``, ``connected``, ``seeds`` (a number or a list), ``reward``, ``guard``, any traced setting."""
    dqn: DQNSettings = DQNSettings()
    params: ParamsSettings = ParamsSettings()
    evaluation: Evaluation = Evaluation()

    @pydantic.model_validator(mode="after")
    def _check(self) -> "Study":
        _check_reward("reward", self.reward)
        _check_axes(self)
        check_ranges(self.params, "params.")
        if self.algorithm == "none" and not self.evaluation.baselines + self.evaluation.planners:
            raise ValueError("algorithm is 'none' and evaluation has neither baselines nor planners; name one to judge")
        return self


def _check_reward(where: str, reward: Any) -> None:
    if isinstance(reward, str):
        if reward not in REWARDS:
            raise ValueError(f"{where} is {reward!r}, which is not a reward; {nearest(reward, REWARDS)}")
    else:
        for term in reward:
            if term not in TERMS:
                raise ValueError(f"{where} has the term {term!r}, which is not one; {nearest(term, TERMS)}")


def _check_axes(study: Study) -> None:
    """Every axis is known, not empty, without repeats, and its values would be valid settings themselves."""
    known = ("powered", "connected", "seeds", "reward", "guard", *TRACED, *TRACED_PARAMS)
    for name in ("powered", "connected", "seeds"):
        if name not in study.axes:
            raise ValueError(f"axes.{name} is missing; give a list of whole numbers")
    for name, values in study.axes.items():
        where = f"axes.{name}"
        if name not in known:
            raise ValueError(f"{where} is not an axis; {nearest(name, known)}")
        if name == "seeds" and isinstance(values, int) and not isinstance(values, bool):
            if not 1 <= values < 2**31:
                raise ValueError(f"{where} is {values}; give at least 1 seed, and fewer than 2**31")
            continue
        if not isinstance(values, list):
            raise ValueError(f"{where} is {values!r}; give a list{' or a number' * (name == 'seeds')}")
        if not values:
            raise ValueError(f"{where} is empty; give at least one value")
        for value in values:
            _check_value(study, name, where, value)
        if len(set(values)) < len(values):
            raise ValueError(f"{where} repeats a value: {values}")


def _check_value(study: Study, name: str, where: str, value: Any) -> None:
    n = study.params.n_devices
    whole = isinstance(value, int) and not isinstance(value, bool)
    if name in ("powered", "connected"):
        if not whole or not 0 <= value <= n:
            raise ValueError(f"{where} has {value!r}; give whole numbers from 0 to {n}, the number of devices")
    elif name == "seeds":
        if not whole or not 0 <= value < 2**31:
            raise ValueError(f"{where} has {value!r}; give whole numbers from 0 to 2147483647")
    elif name == "reward":
        _check_reward(where, value if isinstance(value, str) else str(value))
    elif name == "guard":
        if value not in LOG_GUARDS:
            raise ValueError(f"{where} has {value!r}; {nearest(str(value), LOG_GUARDS)}")
    else:
        settings = DQNSettings if name in TRACED else ParamsSettings
        try:
            settings(**{name: value})
        except pydantic.ValidationError as error:
            raise ValueError(f"{where} has {value!r}; {wanted(error.errors()[0])}") from None

"""Study files: what may stand in one, and one clear line for whatever may not.

The numbers of Table 1 and the hyperparameters are declared once (:class:`Params`, :data:`ALGORITHMS`); the checks of a
study file are made from those declarations.
"""

import dataclasses
import math
from typing import Annotated, Any, Literal, get_args

import pydantic
from pydantic import Field

from uavmec_jax.agents.registry import ALGORITHMS, OF_THE_SCENARIO
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import DEFAULT_REWARD, LOG_GUARDS, REWARDS, TERMS
from uavmec_jax.files.validation import Strict, nearest, settings_model, wanted
from uavmec_jax.planning.beam import WIDTH as BEAM_WIDTH
from uavmec_jax.planning.rollout_planner import SAMPLES as ROLLOUT_SAMPLES
from uavmec_jax.scenarios.distribution import ScenarioSettings, check_scenarios
from uavmec_jax.scenarios.settings import ParamsSettings, check_ranges


def _algorithm_settings(name: str) -> Any:
    declared = ALGORITHMS[name]
    return settings_model(f"{name.upper()}Settings", declared.hyper, declared.spec, leave_out=OF_THE_SCENARIO)


DQNSettings: Any = _algorithm_settings("dqn")
PPOSettings: Any = _algorithm_settings("ppo")
A2CSettings: Any = _algorithm_settings("a2c")

AlgorithmName = Literal["dqn", "ppo", "a2c"]

TRACED_PARAMS = tuple(field.name for field in dataclasses.fields(Params) if isinstance(field.default, int | float))
TRACED_PARAMS = tuple(name for name in TRACED_PARAMS if name != "n_devices")
"""Scenario parameters that may be axes of a study."""

TRAFFIC_WEIGHTS = ("traffic_bonus", "traffic_penalty")
"""Settings that say what traffic weighs in the reward."""

_OTHER_AXES = ("powered", "connected", "cells", "seeds", "algorithm", "reward", "guard", "place", *TRAFFIC_WEIGHTS)

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
    algorithm: Literal[AlgorithmName, "none"] = "dqn"
    """``none`` trains nothing: heuristics and planners alone. Several algorithms are an axis."""
    reward: str | dict[str, float] = DEFAULT_REWARD
    guard: Literal["clamp", "log1p"] = "clamp"
    steps: Annotated[int, Field(ge=1, le=2_000_000_000)] = 1_000_000
    """Environment steps of one agent."""
    place: str = ""
    """A place whose evacuation was simulated: one that ships with the package, or a file. Empty: random towns."""
    place_scale_m: Annotated[float, Field(gt=0)] | None = None
    """Longer side that a place is scaled to (the paper's region: 800); by default distances are the real ones."""
    traffic: Literal["static", "moving"] = "static"
    """Devices' traffic weights: their mean over the evacuation, or as it moves on."""
    traffic_bonus: Annotated[float, Field(ge=0)] = 0.0
    """Added to the reward when a device is visited, times its traffic weight."""
    traffic_penalty: Annotated[float, Field(ge=0)] = 0.0
    """Taken off the reward when a device is the first to fail, times its traffic weight."""
    slot_reward: Annotated[float, Field(ge=0)] = 0.0
    """Added to the reward for every slot that counts."""
    scenarios: ScenarioSettings | None = None
    """What every episode draws a scenario of its own from, in place of the axes ``powered`` and ``connected``."""
    axes: dict[str, Any]
    """``powered`` and ``connected``, or ``cells`` (pairs of the two); ``seeds`` (a number or a list); ``algorithm``,
    ``reward``, ``guard``, ``place``, ``traffic_bonus``, ``traffic_penalty``, any traced setting."""
    dqn: DQNSettings = DQNSettings()
    ppo: PPOSettings = PPOSettings()
    a2c: A2CSettings = A2CSettings()
    params: ParamsSettings = ParamsSettings()
    evaluation: Evaluation = Evaluation()

    @property
    def algorithms(self) -> tuple[str, ...]:
        """Names of the algorithms that it trains."""
        if self.algorithm == "none":
            return ()
        named = self.axes.get("algorithm", [self.algorithm])
        return tuple(name for name in ALGORITHMS if isinstance(named, list) and name in named)

    @pydantic.model_validator(mode="after")
    def _check(self) -> "Study":
        _check_reward("reward", self.reward)
        _check_axes(self)
        _check_traffic(self)
        check_ranges(self.params, "params.")
        _check_drawn(self)
        _check_algorithms(self)
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


def _check_drawn(study: Study) -> None:
    """Drawn scenarios stand where an algorithm can play them, and beside nothing that they would overrule."""
    if study.scenarios is None:
        return
    check_scenarios(study.scenarios, study.params.n_devices)
    if "dqn" in study.algorithms:
        raise ValueError("scenarios are given, and algorithm is 'dqn', which plays one scenario; take 'ppo' or 'a2c'")
    for name in ("place", "traffic_bonus", "traffic_penalty"):
        if getattr(study, name) or name in study.axes:
            raise ValueError(f"{name} is given, and scenarios too, which draw their own; leave one of them out")


def _check_traffic(study: Study) -> None:
    """Traffic stands where there is a place to have it."""
    if study.place or "place" in study.axes:
        return
    for name in (*TRAFFIC_WEIGHTS, "place_scale_m"):
        if getattr(study, name) or name in study.axes:
            raise ValueError(f"{name} is given, but no place; give place, e.g. place = 'albany'")


def _check_algorithms(study: Study) -> None:
    """Settings stand where they have an effect, and fit together."""
    for name in ALGORITHMS:
        if name in study.model_fields_set and name not in study.algorithms and study.algorithms:
            raise ValueError(f"{name} has settings, but the study trains {', '.join(study.algorithms)}; leave them out")
    for name in study.algorithms:
        try:
            ALGORITHMS[name].make(
                getattr(study, name).model_dump(), total_steps=1, n_devices=study.params.n_devices, max_age=1
            )
        except ValueError as error:
            raise ValueError(f"{name}.{error}") from None


def traced(study: Study) -> tuple[str, ...]:
    """Hyperparameters that may be axes of a study: those that all its algorithms have."""
    shared = [ALGORITHMS[name].traced for name in study.algorithms] or [ALGORITHMS["dqn"].traced]
    return tuple(name for name in shared[0] if all(name in others for others in shared))


def _check_known(study: Study, name: str) -> None:
    known = (*_OTHER_AXES, *traced(study), *TRACED_PARAMS)
    if name in known:
        return
    for algorithm in study.algorithms:
        everywhere = {traced for declared in ALGORITHMS.values() for traced in declared.traced}
        if name in everywhere - set(ALGORITHMS[algorithm].traced):
            has = ", ".join(ALGORITHMS[algorithm].traced)
            raise ValueError(f"axes.{name} is not a hyperparameter of {algorithm}, which has {has}")
    raise ValueError(f"axes.{name} is not an axis; {nearest(name, known)}")


def _check_axes(study: Study) -> None:
    """Every axis is known, not empty, without repeats, and its values would be valid settings themselves."""
    if "cells" in study.axes and {"powered", "connected"} & set(study.axes):
        raise ValueError("axes.cells stands beside axes.powered or axes.connected; give the pairs or the two lists")
    counts = ("powered", "connected", "cells")
    if study.scenarios is not None and (given := [name for name in counts if name in study.axes]):
        raise ValueError(f"axes.{given[0]} is given, and scenarios too, which draw their own; leave one of them out")
    drawn_or_cells = "cells" in study.axes or study.scenarios is not None
    for name in ("seeds",) if drawn_or_cells else ("powered", "connected", "seeds"):
        if name not in study.axes:
            raise ValueError(f"axes.{name} is missing; give a list of whole numbers")
    for name, values in study.axes.items():
        where = f"axes.{name}"
        _check_known(study, name)
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
        if any(value in values[:place] for place, value in enumerate(values)):
            raise ValueError(f"{where} repeats a value: {values}")


def _check_value(study: Study, name: str, where: str, value: Any) -> None:
    n = study.params.n_devices
    whole = isinstance(value, int) and not isinstance(value, bool)
    if name in ("powered", "connected"):
        if not whole or not 0 <= value <= n:
            raise ValueError(f"{where} has {value!r}; give whole numbers from 0 to {n}, the number of devices")
    elif name == "cells":
        if not isinstance(value, list) or len(value) != 2:
            raise ValueError(f"{where} has {value!r}; give pairs [powered, connected]")
        for part in value:
            _check_value(study, "powered", where, part)
    elif name == "algorithm":
        if study.algorithm == "none":
            raise ValueError(f"{where} is given, but algorithm is 'none'; leave one of them out")
        if value not in ALGORITHMS:
            raise ValueError(f"{where} has {value!r}; known: {', '.join(ALGORITHMS)}")
    elif name == "seeds":
        if not whole or not 0 <= value < 2**31:
            raise ValueError(f"{where} has {value!r}; give whole numbers from 0 to 2147483647")
    elif name == "reward":
        _check_reward(where, value if isinstance(value, str) else str(value))
    elif name == "guard":
        if value not in LOG_GUARDS:
            raise ValueError(f"{where} has {value!r}; {nearest(str(value), LOG_GUARDS)}")
    elif name == "place":
        if not isinstance(value, str) or not value:
            raise ValueError(f"{where} has {value!r}; give names of places or paths of their files")
    elif name in TRAFFIC_WEIGHTS:
        if not isinstance(value, int | float) or isinstance(value, bool) or not 0 <= value < math.inf:
            raise ValueError(f"{where} has {value!r}; give finite numbers from 0")
    else:
        own = [type(getattr(study, algorithm)) for algorithm in study.algorithms or ("dqn",)]
        for settings in own if name in traced(study) else [ParamsSettings]:
            try:
                settings(**{name: value})
            except pydantic.ValidationError as error:
                raise ValueError(f"{where} has {value!r}; {wanted(error.errors()[0])}") from None

"""The axes of a study: which there are, and which values they may have."""

import dataclasses
import math
from typing import Any

import pydantic

from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import LOG_GUARDS, REWARDS, TERMS
from uavmec_jax.files.validation import expectation, suggest
from uavmec_jax.scenarios.settings import ParamsSettings

TRACED_PARAMS = tuple(
    field.name
    for field in dataclasses.fields(Params)
    if isinstance(field.default, int | float) and field.name != "n_devices"
)
"""Scenario parameters that may be axes of a study."""

TRAFFIC_WEIGHTS = ("traffic_bonus", "traffic_penalty")
"""Settings that weigh traffic in the reward."""

_OTHER_AXES = ("powered", "connected", "cells", "seeds", "algorithm", "reward", "guard", "place", *TRAFFIC_WEIGHTS)


def check_reward(where: str, reward: Any) -> None:
    """Check that a reward is one of Table 6, or weights of known terms.

    Raises:
        ValueError: one line; ``where`` names the setting.
    """
    if isinstance(reward, str):
        if reward not in REWARDS:
            raise ValueError(f"{where} is {reward!r}, which is not a reward; {suggest(reward, REWARDS)}")
    else:
        for term in reward:
            if term not in TERMS:
                raise ValueError(f"{where} has the term {term!r}, which is not one; {suggest(term, TERMS)}")


def traced_settings(study: Any) -> tuple[str, ...]:
    """Return the hyperparameters that may be axes of a study: those that all its algorithms have."""
    shared = [ALGORITHMS[name].traced for name in study.algorithms] or [ALGORITHMS["dqn"].traced]
    return tuple(name for name in shared[0] if all(name in others for others in shared))


def _check_known(study: Any, name: str) -> None:
    known = (*_OTHER_AXES, *traced_settings(study), *TRACED_PARAMS)
    if name in known:
        return
    for algorithm in study.algorithms:
        everywhere = {name for registered in ALGORITHMS.values() for name in registered.traced}
        if name in everywhere - set(ALGORITHMS[algorithm].traced):
            has = ", ".join(ALGORITHMS[algorithm].traced)
            raise ValueError(f"axes.{name} is not a hyperparameter of {algorithm}, which has {has}")
    raise ValueError(f"axes.{name} is not an axis; {suggest(name, known)}")


def check_axes(study: Any) -> None:
    """Check that every axis is known, not empty, without repeats, and that its values would be valid settings.

    Raises:
        ValueError: one line that names the axis.
    """
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


def _check_value(study: Any, name: str, where: str, value: Any) -> None:
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
        check_reward(where, value if isinstance(value, str) else str(value))
    elif name == "guard":
        if value not in LOG_GUARDS:
            raise ValueError(f"{where} has {value!r}; {suggest(str(value), LOG_GUARDS)}")
    elif name == "place":
        if not isinstance(value, str) or not value:
            raise ValueError(f"{where} has {value!r}; give names of places or paths of their files")
    elif name in TRAFFIC_WEIGHTS:
        if not isinstance(value, int | float) or isinstance(value, bool) or not 0 <= value < math.inf:
            raise ValueError(f"{where} has {value!r}; give finite numbers from 0")
    else:
        own = [type(getattr(study, algorithm)) for algorithm in study.algorithms or ("dqn",)]
        for settings in own if name in traced_settings(study) else [ParamsSettings]:
            try:
                settings(**{name: value})
            except pydantic.ValidationError as error:
                raise ValueError(f"{where} has {value!r}; {expectation(error.errors()[0])}") from None

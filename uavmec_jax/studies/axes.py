"""The axes of a study and the values that they may have."""

import dataclasses
from typing import Any

import pydantic

from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.env.fleet import MAX_UAVS
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import LOG_GUARDS, REWARDS, SERVICE_TERM, TERMS
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

MAX_WEIGHT = 1e9
"""Largest weight in a reward."""

_OTHER_AXES = (
    *("powered", "connected", "cells", "seeds", "algorithm", "reward", "guard", "place", *TRAFFIC_WEIGHTS),
    *("uavs", "depots"),
)


def check_reward(where: str, reward: Any) -> None:
    """Check that a reward is one of Table 6, or weights of known terms.

    Raises:
        ValueError: one line; ``where`` names the setting.
    """
    if isinstance(reward, str):
        if reward not in REWARDS:
            raise ValueError(f"{where} is {reward!r}, which is not a reward; {suggest(reward, REWARDS)}")
    else:
        for term, weight in reward.items():
            if term not in (*TERMS, SERVICE_TERM):
                known = suggest(term, (*TERMS, SERVICE_TERM))
                raise ValueError(f"{where} has the term {term!r}, which is not one; {known}")
            if not abs(weight) <= MAX_WEIGHT:
                raise ValueError(f"{where}.{term} is {weight}; give a number from {-MAX_WEIGHT:g} to {MAX_WEIGHT:g}")


def traced_settings(study: Any) -> tuple[str, ...]:
    """Return the hyperparameters that may be axes of a study: those that all its algorithms have."""
    traced = [ALGORITHMS[name].traced for name in study.algorithms or ("dqn",)]
    return tuple(name for name in traced[0] if all(name in others for others in traced))


def check_axes(study: Any) -> None:
    """Check that all axes exist and fit together, and that their values are valid, at least one and without repeats.

    Raises:
        ValueError: one line that names the axis.
    """
    _check_combination(study)
    for name, values in study.axes.items():
        where = f"axes.{name}"
        _check_name(study, name)
        if name == "seeds" and isinstance(values, int) and not isinstance(values, bool):
            if not 1 <= values < 2**31:
                raise ValueError(f"{where} is {values}; give at least 1 seed, and fewer than 2**31")
            continue
        if not isinstance(values, list):
            raise ValueError(f"{where} is {values!r}; give a list{' or a number' * (name == 'seeds')}")
        if not values:
            raise ValueError(f"{where} is empty; give at least one value")
        for value in values:
            _check_value(study, name, value)
        if any(value in values[:index] for index, value in enumerate(values)):
            raise ValueError(f"{where} repeats a value: {values}")


def _check_combination(study: Any) -> None:
    """Check that no axis of cells and seeds is missing or given twice."""
    if "cells" in study.axes and {"powered", "connected"} & set(study.axes):
        raise ValueError("axes.cells is given, and axes.powered or axes.connected too; give the pairs or the two lists")
    counts = ("powered", "connected", "cells")
    if study.scenarios is not None and (given := [name for name in counts if name in study.axes]):
        raise ValueError(f"axes.{given[0]} is given, and scenarios too, which draw their own; leave one of them out")
    cells_known = "cells" in study.axes or study.scenarios is not None
    for name in ("seeds",) if cells_known else ("powered", "connected", "seeds"):
        if name not in study.axes:
            raise ValueError(f"axes.{name} is missing; give a list of whole numbers")


def _check_name(study: Any, name: str) -> None:
    """Check that an axis exists."""
    axes = (*_OTHER_AXES, *traced_settings(study), *TRACED_PARAMS)
    if name in axes:
        return
    hyperparameters = {setting for registered in ALGORITHMS.values() for setting in registered.traced}
    for algorithm in study.algorithms:
        traced = ALGORITHMS[algorithm].traced
        if name in hyperparameters.difference(traced):
            raise ValueError(f"axes.{name} is not a hyperparameter of {algorithm}, which has {', '.join(traced)}")
    raise ValueError(f"axes.{name} is not an axis; {suggest(name, axes)}")


def _check_value(study: Any, name: str, value: Any) -> None:
    """Check one value of an axis."""
    where = f"axes.{name}"
    if name == "algorithm" and study.algorithm == "none":
        raise ValueError(f"{where} is given, but algorithm is 'none'; leave one of them out")
    if name == "reward":
        check_reward(where, value if isinstance(value, str) else str(value))
        return
    is_pair = name == "cells" and isinstance(value, list) and len(value) == 2
    for axis, part in [("powered", count) for count in value] if is_pair else [(name, value)]:
        if expected := _expected(study, axis, part):
            raise ValueError(f"{where} has {part!r}; {expected}")


def _expected(study: Any, name: str, value: Any) -> str:
    """Return what would be right if a value does not fit its axis; empty if it fits."""
    n = study.params.n_devices
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    is_whole = is_number and isinstance(value, int)
    match name:
        case "powered" | "connected":
            fits, expected = is_whole and 0 <= value <= n, f"give whole numbers from 0 to {n}, the number of devices"
        case "cells":
            fits, expected = False, "give pairs [powered, connected]"
        case "algorithm":
            fits, expected = value in tuple(ALGORITHMS), f"known: {', '.join(ALGORITHMS)}"
        case "seeds":
            fits, expected = is_whole and 0 <= value < 2**31, "give whole numbers from 0 to 2147483647"
        case "uavs":
            fits, expected = is_whole and 1 <= value <= MAX_UAVS, f"give whole numbers from 1 to {MAX_UAVS}"
        case "depots":
            fits, expected = is_whole and 0 <= value <= len(study.depot), expected_depots(study)
        case "guard":
            fits, expected = value in LOG_GUARDS, suggest(str(value), LOG_GUARDS)
        case "place":
            fits, expected = (
                isinstance(value, str) and value.isprintable() and value != "",
                "give names of places or paths of their files",
            )
        case "traffic_bonus" | "traffic_penalty":
            fits, expected = is_number and 0 <= value <= MAX_WEIGHT, f"give numbers from 0 to {MAX_WEIGHT:g}"
        case _:
            return _expected_setting(study, name, value)
    return "" if fits else expected


def expected_depots(study: Any) -> str:
    """Return what would be right for a number of depots."""
    most = len(study.depot)
    return (
        f"give whole numbers from 0 to {most}, the number of depot tables" if most else "add a table [[depot]] for each"
    )


def _expected_setting(study: Any, name: str, value: Any) -> str:
    """Return what would be right if a value does not fit a hyperparameter or scenario parameter; empty if it fits."""
    algorithms = study.algorithms or ("dqn",)
    models = [type(getattr(study, algorithm)) for algorithm in algorithms]
    for model in models if name in traced_settings(study) else [ParamsSettings]:
        try:
            model(**{name: value})
        except pydantic.ValidationError as error:
            return expectation(error.errors()[0])
    return ""

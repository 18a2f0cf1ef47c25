"""Checks of results that were read: the tidy table and the arrays against the study that they should be of."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.errors import StudyError
from uavmec_jax.studies.evaluation_result import MISSING
from uavmec_jax.studies.population import cell_axes, seeds_of
from uavmec_jax.studies.schema import PLANNERS, Study

TEXT_AXES = ("algorithm", "reward", "guard", "place", "scenarios")
"""Axes whose values are text."""

MAY_BE_MISSING = ("_planned", "_first_device", "_first_share", "_service", "_censored")
"""Ends of the names of columns of numbers that not every agent has."""

_TRAINED = ("steps", "diverged_at", "best_step", "best_validation")
_OF_POLICIES = (
    "lifetime",
    "lifetime_fixed",
    "cause",
    "cause_fixed",
    "first_device",
    "first_share",
    "first_devices_fixed",
)
_OF_PLANNERS = ("cause", "first_device", "first_share")
_OF_ALL = ("planned", "service", "censored")
"""Ends of the names of columns of the tidy table."""

_CURVES = ("chunk_steps", "episode_length", "validation_steps", "validation")

_RELATIVE = 1e-4
"""Largest difference that rounding makes, relative to the value: numbers of the table have six digits."""

_MOST_SLOTS = 2**31


def policies_of(study: Study) -> list[str]:
    """Return the names of a study's policies as in columns and arrays: trained ones and heuristics."""
    learned = ["best", "last"] if study.algorithms else []
    return learned + [name.replace("-", "_") for name in study.evaluation.baselines]


def check_agents(study: Study, agents: pd.DataFrame, source: object) -> None:
    """Check the columns of the tidy table, and their values.

    Raises:
        StudyError: a column is missing, unknown or of another kind, or a value is not one that it may have.
    """
    required, known = _columns(study)
    if missing := [name for name in required if name not in agents]:
        raise StudyError(f"{source}: has no column {missing[0]!r}")
    if unknown := [name for name in agents if name not in known]:
        raise StudyError(f"{source}: has the column {str(unknown[0])!r}, which the study does not give")
    axes = ["seed", *cell_axes(study)]
    for name in agents:
        column = agents[name]
        if name in axes:
            _check_axis(study, str(name), column, source)
        elif str(name).endswith(("_cause", "_cause_fixed")):
            causes = {"", *(cause.name.lower() for cause in Cause)}
            _check_all(
                column.isin(list(causes)),
                column,
                source,
                f"it should be empty or one of {', '.join(sorted(causes - {''}))}",
            )
        elif str(name).endswith("_devices_fixed"):
            _check_all(column.astype(str).str.fullmatch(r"[0-9 ]*"), column, source, "it should be numbers of devices")
        else:
            _check_numbers(str(name), column, source)


def _columns(study: Study) -> tuple[list[str], set[str]]:
    """Return the columns that the tidy table must have, and all that it may have."""
    axes, trained = ["seed", *cell_axes(study)], list(_TRAINED) if study.algorithms else []
    policies = policies_of(study)
    required = [*axes, *trained, *(f"{name}_{end}" for name in policies for end in _OF_POLICIES)]
    optional = [f"{name}_{end}" for name in (*policies, *study.evaluation.planners) for end in _OF_ALL]
    optional += [f"{name}_{end}" for name in study.evaluation.planners for end in _OF_PLANNERS]
    return required, {*required, *optional}


def _check_axis(study: Study, name: str, column: pd.Series, source: object) -> None:
    """Check that a column holds only values of an axis of the study."""
    if name == "scenarios":
        values: Sequence[Any] = ["drawn"]
    elif name == "seed":
        values = seeds_of(study)
    elif name in ("powered", "connected") and "cells" in study.axes:
        values = [cell[name == "connected"] for cell in study.axes["cells"]]
    else:
        values = study.axes[name]
    expected = f"the study's axis has {', '.join(map(str, values[:8]))}{', ...' * (len(values) > 8)}"
    if name in TEXT_AXES:
        _check_all(column.isin([str(value) for value in values]), column, source, expected)
        return
    if column.dtype.kind not in "iuf":
        raise StudyError(f"{source}: column {name} should hold numbers")
    known, inverse = np.unique(column.to_numpy(float), return_inverse=True)
    near = np.array(
        [np.isclose(value, np.asarray(values, float), rtol=_RELATIVE, atol=0).any() for value in known], bool
    )
    _check_all(near[inverse], column, source, expected)


def _check_numbers(name: str, column: pd.Series, source: object) -> None:
    """Check that a column holds finite numbers, or none where a number may be missing."""
    if column.dtype.kind not in "iuf":
        raise StudyError(f"{source}: column {name} should hold numbers")
    good = np.isfinite(column.to_numpy(float))
    if name.endswith(MAY_BE_MISSING):
        good |= column.isna().to_numpy(bool)
    if name == "best_validation":  # minus infinity before the first validation
        good |= np.isneginf(column.to_numpy(float))
    _check_all(good, column, source, "it should be a finite number")


def _check_all(good: Any, column: pd.Series, source: object, expected: str) -> None:
    """Check that all values of a column are good.

    Raises:
        StudyError: one is not; the line names the row.
    """
    wrong = np.flatnonzero(~np.asarray(good, bool))
    if len(wrong):
        value = column.iloc[wrong[0]]
        shown = repr(value) if isinstance(value, str) else str(value)
        raise StudyError(f"{source}: row {wrong[0] + 1}: {column.name} is {shown[:80]}; {expected}")


def evaluation_shapes(study: Study, agents: int) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return the kind of numbers (``i`` or ``f``) and the shape of each array of an evaluation of so many agents.

    All arrays of a planner may be missing: earlier versions did not evaluate it.
    """
    settings, n = study.evaluation, study.params.n_devices
    planned = min(settings.planner_draws, settings.draws)
    shapes: dict[str, tuple[str, tuple[int, ...]]] = {}
    for name in (*policies_of(study), *settings.planners):
        episodes = planned if name in PLANNERS else settings.draws + 1
        shapes[f"{name}/lifetime"] = ("i", (agents, episodes))
        if name == "bound":
            continue
        shapes[f"{name}/cause"] = ("i", (agents, episodes))
        shapes[f"{name}/first_failure"] = ("f", (agents, episodes, n))
        if study.params.end == "horizon":
            shapes[f"{name}/service_s"] = ("f", (agents, episodes))
    return shapes


def check_evaluation(study: Study, agents: int, evaluation: Mapping[str, np.ndarray], source: object) -> None:
    """Check names, kinds, shapes and values of an evaluation of so many agents.

    Raises:
        StudyError: an array is missing, unknown, of another kind or shape, or holds what no episode gives.
    """
    there = {name.partition("/")[0] for name in evaluation}
    absent = {name for name in PLANNERS if name not in there}
    shapes = {
        name: one for name, one in evaluation_shapes(study, agents).items() if name.partition("/")[0] not in absent
    }
    _check_names(evaluation, shapes, source)
    for name, (kind, shape) in shapes.items():
        array = evaluation[name]
        _check_array(name, array, kind, shape, source)
        planner = name.partition("/")[0] in PLANNERS
        least, most = {
            "lifetime": (MISSING if planner else 0, _MOST_SLOTS),
            "cause": (MISSING if planner else 0, max(Cause)),
            "first_failure": (0.0, 1.0 + _RELATIVE),
            "service_s": (0.0, np.inf),
        }[name.partition("/")[2]]
        good = (array >= least) & (array <= most) & ~np.isinf(array)
        if kind == "f" and planner:
            good |= np.isnan(array)
        _check_values(name, array, good, source, f"from {least} to {most}" if np.isfinite(most) else "at least 0")


def check_curves(study: Study, agents: Mapping[str, int], curves: Mapping[str, np.ndarray], source: object) -> None:
    """Check names, kinds, shapes and values of training curves.

    Args:
        study: the study.
        agents: algorithm -> number of its agents, of those that have any.
        curves: arrays by ``algorithm/curve``.
        source: names the file in messages.

    Raises:
        StudyError: an array is missing, unknown, of another kind or shape, or not finite. A mean episode length may be NaN,
            before an episode has ended.
    """
    _check_names(curves, [f"{algorithm}/{name}" for algorithm in agents for name in _CURVES], source)
    for algorithm, count in agents.items():
        for name, x in (("episode_length", "chunk_steps"), ("validation", "validation_steps")):
            steps, values = curves[f"{algorithm}/{x}"], curves[f"{algorithm}/{name}"]
            _check_array(f"{algorithm}/{x}", steps, "i", (len(steps.ravel()),), source)
            _check_array(f"{algorithm}/{name}", values, "f", (count, len(steps)), source)
            _check_values(f"{algorithm}/{x}", steps, steps >= 0, source, "at least 0")
            good = ~np.isinf(values) if name == "episode_length" else np.isfinite(values)
            _check_values(f"{algorithm}/{name}", values, good, source, "a finite number")


def _check_names(arrays: Iterable[str], expected: Iterable[str], source: object) -> None:
    """Check that the arrays are those that a study gives."""
    there, expected = set(arrays), list(expected)
    if missing := [name for name in expected if name not in there]:
        raise StudyError(f"{source}: has no array {missing[0]!r}")
    if unknown := sorted(there.difference(expected)):
        raise StudyError(f"{source}: has the array {unknown[0]!r}, which the study does not give")


def _check_array(name: str, array: np.ndarray, kind: str, shape: tuple[int, ...], source: object) -> None:
    """Check the kind of numbers and the shape of an array."""
    if array.dtype.kind != kind:
        kinds = {"i": "whole numbers", "f": "floating-point numbers"}
        raise StudyError(f"{source}: array {name!r} is of type {array.dtype}; it should hold {kinds[kind]}")
    if array.shape != shape:
        raise StudyError(f"{source}: array {name!r} has the shape {array.shape}; the study gives {shape}")


def _check_values(name: str, array: np.ndarray, good: np.ndarray, source: object, right: str) -> None:
    """Check that all values of an array are good; ``right`` says in messages what they should be."""
    if not good.all():
        place = np.unravel_index(int(np.argmin(good)), array.shape)
        where = ", ".join(str(int(index) + 1) for index in place)
        raise StudyError(
            f"{source}: array {name!r} holds {array[place]} at [{where}], counted from 1; it should be {right}"
        )

"""Search spaces: files that say which settings are searched, on which scenarios, and when a trial is pruned."""

import itertools
import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field

from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.env.rewards import REWARDS, TERMS
from uavmec_jax.errors import StudyError
from uavmec_jax.files.parsing import parse_toml
from uavmec_jax.files.reading import is_file, read_resource, read_text
from uavmec_jax.files.validation import StrictModel, expectation, from_array, suggest, validated
from uavmec_jax.studies.axes import MAX_WEIGHT
from uavmec_jax.studies.population import seeds_of
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.study import load_study

_LIBRARY = resources.files("uavmec_jax.search") / "library"

_MOST = 1e30
"""Largest number in a range: still a number in float32."""

REWARD = "reward."
"""Prefix of the reward's terms among the settings."""


class Range(StrictModel):
    """All numbers between two bounds."""

    low: float | int
    high: float | int
    log: bool = False
    """Whether they are sampled log-uniformly."""


class Choices(StrictModel):
    """A list of values."""

    choices: Annotated[list[Any], Field(min_length=2)]


class ValidationScenarios(StrictModel):
    """The scenarios on which trials are evaluated: never those that the study reports."""

    seeds: Annotated[int, Field(ge=1, le=1000)] = 2
    first_seed: Annotated[int, Field(ge=0, lt=2**30)] = 1_000_000
    cells: list[Annotated[tuple[int, int], from_array]] | None = None
    """Pairs of powered and connected devices; by default those of the study."""
    draws: Annotated[int, Field(ge=1, le=1000)] = 32


class Halving(StrictModel):
    """Successive halving (Jamieson and Talwalkar, 2016) within a batch."""

    rungs: list[Annotated[float, Field(gt=0, lt=1)]] = Field(default_factory=list)
    """Shares of the training after which the worst trials are pruned; by default no trial is pruned."""
    keep: Annotated[float, Field(gt=0, lt=1)] = 0.5
    """Share of the trials that continue."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> "Halving":
        if any(later <= earlier for earlier, later in itertools.pairwise(self.rungs)):
            raise ValueError(f"halving.rungs is {self.rungs}; give rising shares, each once")
        return self


class Space(StrictModel):
    """A search: the study, the settings to search, the budget and the scenarios."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=80)] = "search"
    study: str
    """The study whose settings are searched: a shipped one or a file."""
    change: dict[str, Any] = Field(default_factory=dict)
    """Settings of the study that the search changes, by dotted names."""
    trials: Annotated[int, Field(ge=1, le=100_000)] = 64
    batch: Annotated[int, Field(ge=1, le=4096)] = 16
    """Number of trials that train together."""
    objective: Literal["mean", "low"] = "mean"
    """The objective: mean lifetime of the weights, or the lower end of its 95 % interval over the scenarios."""
    weights: Literal["best", "last"] = "best"
    """Which weights of a trial are evaluated: those with the best validation score, or the last ones."""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    validation: ValidationScenarios = ValidationScenarios()
    halving: Halving = Halving()
    confirm_seeds: Annotated[int, Field(ge=0, le=1000)] = 5
    """Number of the study's seeds, from 0, on which the best settings are compared with its own; 0 for no comparison."""
    space: dict[str, Range | Choices]
    """Setting -> values to search: hyperparameters, ``reward.TERM``, and static settings, which need choices."""

    def base(self) -> Study:
        """Return the study with the changes of this search.

        Raises:
            StudyError: the study has several algorithms or an axis of settings, or the changes do not fit.
        """
        study = load_study(self.study, self.change)
        if len(study.algorithms) != 1:
            raise StudyError(f"{self.name}: study {self.study!r} trains {len(study.algorithms)} algorithms; search one")
        others = [axis for axis in study.axes if axis not in ("powered", "connected", "cells", "seeds")]
        if others:
            raise StudyError(f"{self.name}: study {self.study!r} has the axis {others[0]}; search one setting of it")
        return study


def shipped_spaces() -> dict[str, Any]:
    """Return the spaces that ship with the package: name -> file."""
    return {Path(file.name).stem: file for file in _LIBRARY.iterdir() if file.name.endswith(".toml")}


def load_space(name_or_path: str, overrides: Mapping[str, Any] | None = None) -> Space:
    """Load a space that ships with the package, or a file.

    Args:
        name_or_path: the name of a shipped space, or a TOML file.
        overrides: settings that replace those of the file.

    Raises:
        StudyError: the file is missing, is not TOML, or has an entry that does not fit.
    """
    library = shipped_spaces()
    if name_or_path in library:
        text = read_resource(library[name_or_path])
    elif not is_file(Path(name_or_path)):
        hint = suggest(Path(name_or_path).stem, library)
        raise StudyError(f"{name_or_path}: neither a file of a search space nor a shipped one; {hint}")
    else:
        text = read_text(Path(name_or_path), StudyError)
    data = {"name": Path(name_or_path).stem} | parse_toml(text, name_or_path, StudyError) | dict(overrides or {})
    space = validated(Space, data, name_or_path, StudyError)
    _check(name_or_path, space)
    return space


def _check(source: str, space: Space) -> None:
    """Raise a StudyError unless every setting can be searched and the scenarios are not those that the study reports."""
    if not space.space:
        raise StudyError(f"{source}: space is empty; give at least one setting to search, e.g. learning_rate")
    study = space.base()
    name = study.algorithms[0]
    declared, settings = ALGORITHMS[name], getattr(study, name)
    names = (*declared.traced, *declared.static, *(REWARD + term for term in TERMS))
    for key, values in space.space.items():
        where = f"{source}: space.{key}"
        if key not in names:
            raise StudyError(f"{where} is not a setting of {name}; {suggest(key, names)}")
        if isinstance(values, Range):
            _check_range(where, key, values, declared.static)
        elif repeated := [value for k, value in enumerate(values.choices) if value in values.choices[:k]]:
            raise StudyError(f"{where} has {repeated[0]!r} twice among its choices; give each once")
        for value in boundary_values(values):
            if not key.startswith(REWARD):
                _check_value(where, type(settings), key, value)
            elif isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_WEIGHT:
                raise StudyError(f"{where} has {value!r}; give numbers from {-MAX_WEIGHT:g} to {MAX_WEIGHT:g}")
    scenarios = space.validation
    reported = set(seeds_of(study)) & set(range(scenarios.first_seed, scenarios.first_seed + scenarios.seeds))
    if reported:
        raise StudyError(
            f"{source}: validation.first_seed is {scenarios.first_seed}: the study reports the scenarios of seed "
            f"{min(reported)}; give a number beyond its seeds"
        )
    for cell in scenarios.cells or ():
        if not all(0 <= count <= study.params.n_devices for count in cell):
            raise StudyError(
                f"{source}: validation.cells has {list(cell)}; give counts from 0 to {study.params.n_devices}"
            )


def _check_range(where: str, key: str, values: Range, static: tuple[str, ...]) -> None:
    if key in static:
        raise StudyError(f"{where} has low and high, but shapes the program; give choices = [...]")
    if not -_MOST <= values.low < values.high <= _MOST:
        raise StudyError(f"{where} has low {values.low} and high {values.high}; give low < high, at most {_MOST:g}")
    if values.log and values.low <= 0:
        raise StudyError(f"{where} has low {values.low} and log = true; give low > 0")


def _check_value(where: str, settings: Any, key: str, value: Any) -> None:
    whole = isinstance(settings.model_fields[key].default, int) and isinstance(value, float) and value.is_integer()
    try:
        settings(**{key: int(value) if whole else tuple(value) if isinstance(value, list) else value})
    except pydantic.ValidationError as error:
        raise StudyError(f"{where} has {value!r}; {expectation(error.errors()[0])}") from None


def boundary_values(values: Range | Choices) -> list[Any]:
    """Return all choices, or both ends of a range."""
    return values.choices if isinstance(values, Choices) else [values.low, values.high]


def contains(values: Range | Choices, value: Any) -> bool:
    """Return whether a value is one of those that are searched."""
    return value in values.choices if isinstance(values, Choices) else values.low <= value <= values.high


def static_settings(space: Space) -> list[str]:
    """Return the searched settings that shape the program, and are thus the same for all trials of a batch."""
    declared = ALGORITHMS[space.base().algorithms[0]]
    return [key for key in space.space if key in declared.static]


def static_combinations(space: Space) -> list[dict[str, Any]]:
    """Return every combination of the static settings; the study's own first, if it is one of them."""
    names = static_settings(space)
    baseline = {key: value for key, value in baseline_settings(space).items() if key in names}
    choices = [values.choices for key in names if isinstance(values := space.space[key], Choices)]
    combinations = [dict(zip(names, combination, strict=True)) for combination in itertools.product(*choices)]
    return sorted(combinations, key=lambda combination: combination != baseline) if names else []


def baseline_settings(space: Space) -> dict[str, Any]:
    """Return the study's own values of the searched settings."""
    study = space.base()
    settings = getattr(study, study.algorithms[0])
    reward = reward_terms(study)
    return {
        key: reward.get(key.removeprefix(REWARD), 0.0) if key.startswith(REWARD) else toml_value(getattr(settings, key))
        for key in space.space
    }


def reward_terms(study: Study) -> dict[str, float]:
    """Return the weights of a study's reward by term."""
    if isinstance(study.reward, dict):
        return dict(study.reward)
    return {term: float(w) for term, w in zip(TERMS, REWARDS[study.reward], strict=True) if w}


def toml_value(value: Any) -> Any:
    """Convert a setting to the types of TOML and JSON, which have no tuples."""
    return list(value) if isinstance(value, tuple) else value


def reward_with(study: Study, values: Mapping[str, Any]) -> dict[str, float]:
    """Return the weights of a study's reward by term, with the weights among a trial's settings."""
    searched = {key.removeprefix(REWARD): float(value) for key, value in values.items() if key.startswith(REWARD)}
    return reward_terms(study) | searched


def study_changes(space: Space, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the changes of the study that a search and the settings of a trial make, by dotted names."""
    study = space.base()
    name = study.algorithms[0]
    changes = {f"{name}.{key}": value for key, value in values.items() if not key.startswith(REWARD)}
    reward = {"reward": reward_with(study, values)} if any(key.startswith(REWARD) for key in values) else {}
    return dict(space.change) | changes | reward


def identity(space: Space) -> str:
    """Return the text that identifies a search; one with more trials is still the same search."""
    return json.dumps(space.model_dump(mode="json", exclude={"trials", "confirm_seeds"}), sort_keys=True)

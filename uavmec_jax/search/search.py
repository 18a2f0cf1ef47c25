"""The search itself: Optuna proposes a batch of trials, the batch trains as one population, Optuna is told."""

import json
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from uavmec_jax.errors import StudyError
from uavmec_jax.files.writing import write_text
from uavmec_jax.search.halving import SuccessiveHalving, TrialOutcome
from uavmec_jax.search.space import (
    Choices,
    Range,
    Space,
    baseline_settings,
    digest,
    holds,
    outer,
    outer_combinations,
    settings_of,
)
from uavmec_jax.studies.study import load_study, study_toml
from uavmec_jax.training import host

if TYPE_CHECKING:
    import optuna

DATABASE, TRIALS, BEST, FACTS = "trials.db", "trials.csv", "best.toml", "search.json"

_BATCH = "batch"


@dataclass(frozen=True)
class SearchProgress:
    """How far a search is: trials that are over, of how many; of the batch at hand its share and the trials left in it."""

    trials: int
    total_trials: int
    share: float
    left: int
    best: float


@dataclass(frozen=True)
class SearchResult:
    """What a search found.

    Attributes:
        space: that was searched.
        trials: table: ``number``, ``batch``, ``state`` (``complete`` or ``pruned``), ``value``, ``steps`` it was trained,
            and its settings.
        importance: setting -> share of the variance of the objective (PED-ANOVA; Watanabe et al., 2023).
        best: settings of the best trial.
    """

    space: Space
    trials: pd.DataFrame
    importance: dict[str, float]
    best: dict[str, Any]

    @property
    def value(self) -> float:
        """The objective of the best trial."""
        return float(self.trials.loc[self.trials["state"] == "complete", "value"].max())

    @property
    def own_value(self) -> float:
        """The objective of the study's own settings (trial 0); of one that was given up, as far as it was trained."""
        return float(self.trials.loc[self.trials["number"] == 0, "value"].iloc[0])


def run_search(
    space: Space,
    directory: str | Path,
    *,
    command: str = "",
    on_progress: Callable[[SearchProgress], None] = lambda _: None,
) -> SearchResult:
    """Search, or go on with a search that was stopped; a batch that was under way is made again, with the same trials.

    Args:
        space: from :func:`uavmec_jax.search.space.load_space`.
        directory: of the search: its database, table, and best settings.
        command: the command line, for the label.
        on_progress: told while batches train.

    Raises:
        StudyError: Optuna is not installed, the directory holds another search or something else, or a batch does not
            fit in memory.
    """
    optuna = _optuna()
    path = Path(directory)
    _check_directory(path, space)
    path.mkdir(parents=True, exist_ok=True)
    write_text(path / FACTS, json.dumps({"space": space.model_dump(mode="json"), "command": command} | host.describe()))
    trials = _open(optuna, path, space)
    halving = SuccessiveHalving(space)
    batches = math.ceil(space.trials / space.batch)
    for batch in range(batches):
        members = _proposed(optuna, trials, space, batch)
        if all(trial.state.is_finished() for trial in members):
            continue

        def report(share: float, left: int, over: int = batch * space.batch) -> None:
            on_progress(SearchProgress(over, space.trials, share, left, _best_value(trials)))

        halving.on_progress = report
        outcomes = halving.run([_values(space, trial.params) for trial in members])
        for trial, outcome in zip(members, outcomes, strict=True):
            if not trial.state.is_finished():
                _tell(optuna, trials, trial, outcome)
    found = _found(optuna, trials, space)
    write_text(path / TRIALS, found.trials.to_csv(index=False, float_format="%.6g"))
    write_text(path / BEST, study_toml(best_study(found)))
    return found


def best_study(found: SearchResult) -> Any:
    """The study with the best settings."""
    study = load_study(found.space.study, settings_of(found.space, found.best))
    return study.model_copy(update={"name": f"{found.space.name}-best"})


def _optuna() -> Any:
    optuna = host.optional("optuna", "search", "search")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def _check_directory(path: Path, space: Space) -> None:
    """A new or empty folder, or one of this very search."""
    if path.exists() and not path.is_dir():
        raise StudyError(f"{path}: exists and is not a folder; give another one with --out")
    if not path.exists() or not any(path.iterdir()):
        return
    try:
        before = Space.model_validate(json.loads((path / FACTS).read_text(encoding="utf-8"))["space"], strict=True)
    except (OSError, ValueError, KeyError, TypeError):
        raise StudyError(f"{path}: is not empty and holds no search; give another folder with --out") from None
    if digest(before) != digest(space):
        raise StudyError(f"{path}: holds another search; give another folder with --out")


def _open(optuna: Any, path: Path, space: Space) -> "optuna.Study":
    """The search's database; its first trial has the study's own settings, as far as they lie in the space."""
    from sqlalchemy import URL
    from sqlalchemy.exc import DatabaseError

    url = URL.create("sqlite", database=str(path / DATABASE)).render_as_string()
    try:
        storage = optuna.storages.RDBStorage(url)
        trials = optuna.create_study(storage=storage, study_name=space.name, direction="maximize", load_if_exists=True)
    except DatabaseError as error:
        raise StudyError(f"{path / DATABASE}: cannot be read: {error.orig!s}") from None
    if not trials.get_trials(deepcopy=False):
        own = baseline_settings(space)
        trials.enqueue_trial({key: _told(own[key]) for key, values in space.space.items() if holds(values, own[key])})
    return trials


def _proposed(optuna: Any, trials: "optuna.Study", space: Space, batch: int) -> list[Any]:
    """The trials of a batch: those that were already proposed, and as many new ones as are missing.

    Every proposal has a sampler of its own, seeded by the trial's number, so that a search that was stopped proposes
    what it would have proposed. The outer settings are the same for all of a batch: the first batches have one
    combination each, until all were tried; later ones have what the sampler chooses for their first trial.
    """
    names, combinations, own = outer(space), outer_combinations(space), baseline_settings(space)
    size = min(space.batch, space.trials - batch * space.batch)
    members = [trial for trial in trials.get_trials(deepcopy=False) if trial.user_attrs.get(_BATCH) == batch]
    while len(members) < size:
        number = batch * space.batch + len(members)
        sampler = optuna.samplers.TPESampler(
            seed=space.seed * 1_000_003 + number, multivariate=True, n_startup_trials=space.batch
        )
        if members:
            fixed = {key: members[0].params[key] for key in names}
        else:
            fixed = (
                {key: _told(value) for key, value in combinations[batch].items()} if batch < len(combinations) else {}
            )
        if fixed:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
                sampler = optuna.samplers.PartialFixedSampler(fixed, sampler)
        trials.sampler = sampler
        trial = trials.ask()
        for key, values in space.space.items():
            _suggest(trial, key, values, own[key])
        trial.set_user_attr(_BATCH, batch)
        members.append(trials.get_trials(deepcopy=False)[trial.number])
    return sorted(members, key=lambda trial: trial.number)


def _suggest(trial: Any, key: str, values: Range | Choices, own: Any) -> None:
    if isinstance(values, Choices):
        trial.suggest_categorical(key, [_told(value) for value in values.choices])
    elif isinstance(own, int) and not isinstance(own, bool):
        trial.suggest_int(key, int(values.low), int(values.high), log=values.log)
    else:
        trial.suggest_float(key, float(values.low), float(values.high), log=values.log)


def _told(value: Any) -> Any:
    """A value as Optuna takes it: lists are text."""
    return json.dumps(value) if isinstance(value, list) else value


def _values(space: Space, params: Mapping[str, Any]) -> dict[str, Any]:
    """A trial's settings as the study takes them."""
    lists = {key for key, one in space.space.items() if isinstance(one, Choices) and isinstance(one.choices[0], list)}
    return {key: json.loads(params[key]) if key in lists else params[key] for key in space.space}


def _tell(optuna: Any, trials: "optuna.Study", trial: Any, outcome: TrialOutcome) -> None:
    live = optuna.trial.Trial(trials, trial._trial_id)
    for step, value in outcome.rungs.items():
        live.report(value, step)
    if outcome.value is None:
        trials.tell(trial.number, state=optuna.trial.TrialState.PRUNED)
    else:
        trials.tell(trial.number, outcome.value)


def _best_value(trials: "optuna.Study") -> float:
    values = [trial.value for trial in trials.get_trials(deepcopy=False) if trial.state.name == "COMPLETE"]
    return max((value for value in values if value is not None), default=float("nan"))


def _found(optuna: Any, trials: "optuna.Study", space: Space) -> SearchResult:
    rows = []
    for trial in trials.get_trials(deepcopy=False)[: space.trials]:
        if trial.state.is_finished():
            facts = {"number": trial.number, "batch": trial.user_attrs[_BATCH], "state": trial.state.name.lower()}
            facts |= {"value": trial.value, "steps": max(trial.intermediate_values, default=0)}
            rows.append(facts | {key: _told(value) for key, value in _values(space, trial.params).items()})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            evaluator = optuna.importance.PedAnovaImportanceEvaluator()
            importance = optuna.importance.get_param_importances(trials, evaluator=evaluator)
        except (ValueError, RuntimeError):  # fewer than two trials that are complete, or all alike
            importance = {}
    return SearchResult(space, pd.DataFrame(rows), dict(importance), _values(space, trials.best_params))

"""The search: Optuna proposes a batch of trials, the batch trains as one population, and Optuna gets the outcomes."""

import json
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from uavmec_jax.cluster.connection import connected
from uavmec_jax.cluster.options import RayOptions
from uavmec_jax.errors import StudyError
from uavmec_jax.files.extras import optional
from uavmec_jax.files.locations import local_path
from uavmec_jax.files.writing import write_text
from uavmec_jax.search.halving import SuccessiveHalving, TrialOutcome
from uavmec_jax.search.space import (
    Choices,
    Range,
    Space,
    baseline_settings,
    contains,
    identity,
    static_combinations,
    static_settings,
    study_changes,
)
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.study import load_study, study_toml
from uavmec_jax.training import host
from uavmec_jax.training.machine import probe_node

if TYPE_CHECKING:
    import optuna

DATABASE, TRIALS, BEST, FACTS = "trials.db", "trials.csv", "best.toml", "search.json"

_BATCH = "batch"


@dataclass(frozen=True)
class SearchProgress:
    """The progress of a search, and of the batch in training.

    Attributes:
        trials: finished trials.
        total_trials: number of trials.
        batch_share: finished share of the batch.
        batch_trials: trials of the batch that have not been pruned.
        best: best objective so far; NaN before the first batch is finished.
    """

    trials: int
    total_trials: int
    batch_share: float
    batch_trials: int
    best: float


@dataclass(frozen=True)
class SearchResult:
    """The result of a search.

    Attributes:
        space: the search space.
        trials: one row per trial: ``number``, ``batch``, ``state`` (``complete`` or ``pruned``), ``value`` of the
            objective, environment ``steps`` of its training, and its settings.
        importance: setting -> share of the objective's variance (PED-ANOVA; Watanabe et al., 2023).
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
    def baseline_value(self) -> float:
        """The objective of the study's own settings (trial 0); if that trial was pruned, its score at the last rung."""
        return float(self.trials.loc[self.trials["number"] == 0, "value"].iloc[0])


def run_search(
    space: Space,
    directory: str | Path,
    *,
    command: str = "",
    ray: RayOptions | str | bool | None = None,
    on_progress: Callable[[SearchProgress], None] = lambda _: None,
) -> SearchResult:
    """Run a search, or continue one that was stopped: an unfinished batch is repeated with the same trials.

    On Ray, each shard of a batch is a task from one rung to the next. A shard whose node dies begins again at the last rung.

    Args:
        space: from :func:`uavmec_jax.search.space.load_space`.
        directory: folder of the search, on this machine: its database, table and best settings.
        command: the command line, for the label.
        ray: train the batches on Ray: ``True`` for the cluster of ``RAY_ADDRESS``, else one on this machine; an address;
            or options. All nodes must have the same version of this package.
        on_progress: called while batches train; on Ray, whenever a shard gets to a rung.

    Raises:
        StudyError: Optuna is not installed, the directory holds another search or something else, or a batch does not
            fit in memory; on Ray, also if it is not installed or cannot be reached, a node has other code, or a shard failed.
    """
    optuna = _import_optuna()
    path = local_path(directory, "the database of a search")
    _check_directory(path, space)
    path.mkdir(parents=True, exist_ok=True)
    write_text(path / FACTS, json.dumps({"space": space.model_dump(mode="json"), "command": command} | host.describe()))
    trials = _open_trials(optuna, path, space)
    with connected(RayOptions.of(ray)) as cluster:
        halving = SuccessiveHalving(space, cluster, probe_node(cluster) if cluster else None)
        _run_batches(optuna, trials, halving, on_progress)
    result = _search_result(optuna, trials, space)
    write_text(path / TRIALS, result.trials.to_csv(index=False, float_format="%.6g"))
    write_text(path / BEST, study_toml(best_study(result)))
    return result


def _run_batches(
    optuna: Any,
    trials: "optuna.Study",
    halving: SuccessiveHalving,
    on_progress: Callable[[SearchProgress], None],
) -> None:
    """Run the batches of a search that are not finished, and store their outcomes."""
    space = halving.space
    for batch in range(math.ceil(space.trials / space.batch)):
        members = _propose_batch(optuna, trials, space, batch)
        if all(trial.state.is_finished() for trial in members):
            continue

        def report(share: float, batch_trials: int, finished: int = batch * space.batch) -> None:
            on_progress(SearchProgress(finished, space.trials, share, batch_trials, _best_value(trials)))

        halving.on_progress = report
        outcomes = halving.run([_settings(space, trial.params) for trial in members])
        for trial, outcome in zip(members, outcomes, strict=True):
            if not trial.state.is_finished():
                _record(optuna, trials, trial, outcome)


def best_study(result: SearchResult) -> Study:
    """Return the study with the best settings."""
    study = load_study(result.space.study, study_changes(result.space, result.best))
    return study.model_copy(update={"name": f"{result.space.name}-best"})


def _import_optuna() -> Any:
    optuna = optional("optuna", "search", "search")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def _check_directory(path: Path, space: Space) -> None:
    """Raise a StudyError unless the folder is new, empty, or holds this very search."""
    if path.exists() and not path.is_dir():
        raise StudyError(f"{path}: exists and is not a folder; give another one with --out")
    if not path.exists() or not any(path.iterdir()):
        return
    try:
        before = Space.model_validate(json.loads((path / FACTS).read_text(encoding="utf-8"))["space"], strict=True)
    except (OSError, ValueError, KeyError, TypeError):
        raise StudyError(f"{path}: is not empty and holds no search; give another folder with --out") from None
    if identity(before) != identity(space):
        raise StudyError(f"{path}: holds another search; give another folder with --out")


def _open_trials(optuna: Any, path: Path, space: Space) -> "optuna.Study":
    """Open the database; the first trial of a new one has the study's own settings, as far as the space contains them."""
    from sqlalchemy import URL
    from sqlalchemy.exc import DatabaseError

    url = URL.create("sqlite", database=str(path / DATABASE)).render_as_string()
    try:
        storage = optuna.storages.RDBStorage(url)
        trials = optuna.create_study(storage=storage, study_name=space.name, direction="maximize", load_if_exists=True)
    except DatabaseError as error:
        raise StudyError(f"{path / DATABASE}: cannot be read: {error.orig!s}") from None
    if not trials.get_trials(deepcopy=False):
        baseline = baseline_settings(space)
        inside = {key: value for key, value in baseline.items() if contains(space.space[key], value)}
        trials.enqueue_trial({key: _to_optuna(value) for key, value in inside.items()})
    return trials


def _propose_batch(optuna: Any, trials: "optuna.Study", space: Space, batch: int) -> list[Any]:
    """Return the trials of a batch: those that were proposed before, and new ones for those that are missing.

    Each proposal has its own sampler, seeded by the trial's number, so that a search that was stopped continues with the
    proposals of an uninterrupted one. All trials of a batch share their static settings: each of the first batches has
    one combination, until all were tried; in later batches the sampler chooses them for the first trial.
    """
    names, combinations, baseline = static_settings(space), static_combinations(space), baseline_settings(space)
    size = min(space.batch, space.trials - batch * space.batch)
    members = [trial for trial in trials.get_trials(deepcopy=False) if trial.user_attrs.get(_BATCH) == batch]
    while len(members) < size:
        number = batch * space.batch + len(members)
        sampler = optuna.samplers.TPESampler(
            seed=space.seed * 1_000_003 + number, multivariate=True, n_startup_trials=space.batch
        )
        fixed: dict[str, Any] = {}
        if members:
            fixed = {key: members[0].params[key] for key in names}
        elif batch < len(combinations):
            fixed = {key: _to_optuna(value) for key, value in combinations[batch].items()}
        if fixed:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
                sampler = optuna.samplers.PartialFixedSampler(fixed, sampler)
        trials.sampler = sampler
        trial = trials.ask()
        for key, values in space.space.items():
            _suggest(trial, key, values, baseline[key])
        trial.set_user_attr(_BATCH, batch)
        members.append(trials.get_trials(deepcopy=False)[trial.number])
    return sorted(members, key=lambda trial: trial.number)


def _suggest(trial: Any, key: str, values: Range | Choices, baseline: Any) -> None:
    """Let Optuna choose a setting of a trial, as a whole number if the study's own value is one."""
    if isinstance(values, Choices):
        trial.suggest_categorical(key, [_to_optuna(value) for value in values.choices])
    elif isinstance(baseline, int) and not isinstance(baseline, bool):
        trial.suggest_int(key, int(values.low), int(values.high), log=values.log)
    else:
        trial.suggest_float(key, float(values.low), float(values.high), log=values.log)


def _to_optuna(value: Any) -> Any:
    """Convert a setting for Optuna, which stores lists as text."""
    return json.dumps(value) if isinstance(value, list) else value


def _settings(space: Space, params: Mapping[str, Any]) -> dict[str, Any]:
    """Convert Optuna's parameters of a trial back into settings."""
    lists = {
        key
        for key, values in space.space.items()
        if isinstance(values, Choices) and isinstance(values.choices[0], list)
    }
    return {key: json.loads(params[key]) if key in lists else params[key] for key in space.space}


def _record(optuna: Any, trials: "optuna.Study", trial: Any, outcome: TrialOutcome) -> None:
    """Store the outcome of a trial."""
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


def _search_result(optuna: Any, trials: "optuna.Study", space: Space) -> SearchResult:
    """Build the result from the database."""
    rows = []
    for trial in trials.get_trials(deepcopy=False)[: space.trials]:
        if trial.state.is_finished():
            row = {"number": trial.number, "batch": trial.user_attrs[_BATCH], "state": trial.state.name.lower()}
            row |= {"value": trial.value, "steps": max(trial.intermediate_values, default=0)}
            rows.append(row | {key: _to_optuna(value) for key, value in _settings(space, trial.params).items()})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            evaluator = optuna.importance.PedAnovaImportanceEvaluator()
            importance = optuna.importance.get_param_importances(trials, evaluator=evaluator)
        except (ValueError, RuntimeError):  # fewer than two complete trials, or all with the same objective
            importance = {}
    return SearchResult(space, pd.DataFrame(rows), dict(importance), _settings(space, trials.best_params))

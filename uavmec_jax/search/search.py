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
from uavmec_jax.files.writing import write_text
from uavmec_jax.search.folder import BATCH, BEST, TRIALS, import_optuna, opened_trials, search_folder, to_optuna
from uavmec_jax.search.halving import SuccessiveHalving, TrialOutcome
from uavmec_jax.search.space import (
    Choices,
    Range,
    Space,
    baseline_settings,
    contains,
    static_combinations,
    static_settings,
    study_changes,
)
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.study import load_study, study_toml
from uavmec_jax.training.machine import probe_node

if TYPE_CHECKING:
    import optuna


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
        StudyError: Optuna is not installed, the directory holds another search or something else, another process works in
            it or has locked the database, or a batch does not fit in memory; on Ray, also if it is not installed or cannot
            be reached, a node has other code, or a shard failed.
    """
    with search_folder(directory, space, command) as path:
        return continue_search(space, path, ray=ray, on_progress=on_progress)


def continue_search(
    space: Space,
    path: Path,
    *,
    ray: RayOptions | str | bool | None = None,
    on_progress: Callable[[SearchProgress], None] = lambda _: None,
) -> SearchResult:
    """Run a search in a folder that :func:`search_folder` holds; otherwise as :func:`run_search`."""
    optuna = import_optuna()
    with opened_trials(path, space) as trials:
        _enqueue_baseline(trials, space)
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

        finished, best = batch * space.batch, _best_value(trials)

        def report(share: float, batch_trials: int, finished: int = finished, best: float = best) -> None:
            on_progress(SearchProgress(finished, space.trials, share, batch_trials, best))

        halving.on_progress = report
        outcomes = halving.run([_settings(space, trial.params) for trial in members])
        for trial, outcome in zip(members, outcomes, strict=True):
            if not trial.state.is_finished():
                _record(optuna, trials, trial, outcome)
    for trial in trials.get_trials(deepcopy=False):  # proposed before a stop, when the search was to have more trials
        if not trial.state.is_finished():
            trials.tell(trial.number, state=optuna.trial.TrialState.FAIL)


def best_study(result: SearchResult) -> Study:
    """Return the study with the best settings."""
    study = load_study(result.space.study, study_changes(result.space, result.best))
    return study.model_copy(update={"name": f"{result.space.name}-best"})


def _enqueue_baseline(trials: "optuna.Study", space: Space) -> None:
    """Let the first trial of a new search have the study's own settings, as far as the space contains them."""
    if not trials.get_trials(deepcopy=False):
        baseline = baseline_settings(space)
        inside = {key: value for key, value in baseline.items() if contains(space.space[key], value)}
        trials.enqueue_trial({key: to_optuna(value) for key, value in inside.items()})


def _propose_batch(optuna: Any, trials: "optuna.Study", space: Space, batch: int) -> list[Any]:
    """Return the trials of a batch: those that were proposed before, and new ones for those that are missing.

    Each proposal has its own sampler, seeded by the trial's number, so that a search that was stopped continues with the
    proposals of an uninterrupted one. All trials of a batch share their static settings: each of the first batches has
    one combination, until all were tried; in later batches the sampler chooses them for the first trial.
    """
    names, combinations, baseline = static_settings(space), static_combinations(space), baseline_settings(space)
    size = min(space.batch, space.trials - batch * space.batch)
    members = [trial for trial in _proposed(trials) if trial.user_attrs.get(BATCH) == batch]
    while len(members) < size:
        number = batch * space.batch + len(members)
        sampler = optuna.samplers.TPESampler(
            seed=space.seed * 1_000_003 + number, multivariate=True, n_startup_trials=space.batch
        )
        fixed: dict[str, Any] = {}
        if members:
            fixed = {key: members[0].params[key] for key in names}
        elif batch < len(combinations):
            fixed = {key: to_optuna(value) for key, value in combinations[batch].items()}
        if fixed:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
                sampler = optuna.samplers.PartialFixedSampler(fixed, sampler)
        trials.sampler = sampler
        trial = trials.ask()
        for key, values in space.space.items():
            _suggest(trial, key, values, baseline[key])
        trial.set_user_attr(BATCH, batch)
        members.append(trials.get_trials(deepcopy=False)[trial.number])
    return sorted(members, key=lambda trial: trial.number)[:size]


def _proposed(trials: "optuna.Study") -> list[Any]:
    """Return the trials without those that were given up."""
    return [trial for trial in trials.get_trials(deepcopy=False) if trial.state.name != "FAIL"]


def _suggest(trial: Any, key: str, values: Range | Choices, baseline: Any) -> None:
    """Let Optuna choose a setting of a trial, as a whole number if the study's own value is one."""
    if isinstance(values, Choices):
        trial.suggest_categorical(key, [to_optuna(value) for value in values.choices])
    elif isinstance(baseline, int) and not isinstance(baseline, bool):
        trial.suggest_int(key, int(values.low), int(values.high), log=values.log)
    else:
        trial.suggest_float(key, float(values.low), float(values.high), log=values.log)


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
        if step not in trial.intermediate_values:  # stored before a search was stopped
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
    for trial in _proposed(trials)[: space.trials]:
        if trial.state.is_finished():
            row = {"number": trial.number, "batch": trial.user_attrs[BATCH], "state": trial.state.name.lower()}
            row |= {"value": trial.value, "steps": max(trial.intermediate_values, default=0)}
            rows.append(row | {key: to_optuna(value) for key, value in _settings(space, trial.params).items()})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            evaluator = optuna.importance.PedAnovaImportanceEvaluator()
            importance = optuna.importance.get_param_importances(trials, evaluator=evaluator)
        except (ValueError, RuntimeError):  # fewer than two complete trials, or all with the same objective
            importance = {}
    return SearchResult(space, pd.DataFrame(rows), dict(importance), _settings(space, trials.best_params))

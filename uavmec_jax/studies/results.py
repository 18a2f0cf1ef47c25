"""What a run leaves: files that are read back without pickle, each written whole or not at all."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from flax import traverse_util

from uavmec_jax.errors import StudyError
from uavmec_jax.files import load_arrays, write_arrays, write_text
from uavmec_jax.studies.collection import WEIGHTS, Collection, read_collection, write_collection
from uavmec_jax.studies.evaluation import device_number
from uavmec_jax.studies.schema import PLANNERS, Study
from uavmec_jax.studies.statistics import mean_interval
from uavmec_jax.studies.study import cell_axes, load_study, study_toml

SCHEMA = 2
"""Version of the run folder. In version 1 curves and weights did not name their algorithm: it was the DQN."""

_STUDY, _RUN, _AGENTS = "study.toml", "run.json", "agents.csv"
_CURVES, _EVALUATION = "curves.npz", "evaluation.npz"


@dataclass
class Results:
    """One run, whole or as far as it got.

    Attributes:
        study: the resolved study.
        run: what ``run.json`` holds: versions, hardware, command, seeds, times, speed.
        agents: tidy table, one row per finished agent.
        curves: per algorithm, of its agents: ``chunk_steps [C]``, ``episode_length [A, C]``, ``look_steps [L]``,
            ``validation [A, L]``.
        evaluation: per policy ``<name>/lifetime [A, D + 1]``, ``/cause``, ``/first_failure [A, D + 1, n]``; of the
            planners ``[A, P]`` and ``[A, P, n]``, the bound has lifetimes only.
        weights: ``<algorithm>/best/...`` and ``<algorithm>/last/...``, leaves ``[A, ...]`` of its agents (empty when
            read back by :func:`load_results`).
    """

    study: Study
    run: dict[str, Any]
    agents: pd.DataFrame = field(default_factory=pd.DataFrame)
    curves: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    evaluation: dict[str, np.ndarray] = field(default_factory=dict)
    weights: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def policies(self) -> list[str]:
        """Policies in the table, as in its column names."""
        return [name.removesuffix("_lifetime") for name in self.agents.columns if name.endswith("_lifetime")]

    @property
    def shown(self) -> str:
        """The policy that the tables are about: the best weights, or, where nothing was trained, the best heuristic."""
        preferred = ("best", "earliest_deadline", *self.policies, *PLANNERS)
        return next((name for name in preferred if f"{name}_first_device" in self.agents), "bound")

    @property
    def gaps(self) -> list[tuple[str, str]]:
        """Pairs ``(upper, lower)`` of neighbours on the way from the shown policy to the upper bound."""
        ladder = [name for name in (self.shown, *PLANNERS) if f"{name}_planned" in self.agents]
        return list(zip(ladder[1:], ladder, strict=False))

    @property
    def _over_oldest(self) -> list[str]:
        """Learned policies to be held against oldest-first, layout by layout."""
        return [name for name in ("best", "last") if {name, "oldest_first"} <= set(self.policies)]

    def add(
        self, algorithm: str, rows: pd.DataFrame, curves: Mapping, evaluation: Mapping, weights: Mapping[str, Any]
    ) -> None:
        """Append the agents of one more block of an algorithm."""
        self.agents = pd.concat([self.agents, rows], ignore_index=True)
        if curves:
            _append(self.curves.setdefault(algorithm, {}), curves)
        _append(self.evaluation, evaluation)
        _append(self.weights, traverse_util.flatten_dict({algorithm: dict(weights)}, sep="/") if weights else {})

    def cells(self) -> pd.DataFrame:
        """One row per cell: means and intervals over the seeds, paired differences to oldest-first, who fails first."""
        rows = []
        for cell, group in self.agents.groupby(cell_axes(self.study), sort=False):
            row: dict[str, Any] = dict(zip(cell_axes(self.study), cell, strict=True)) | {"seeds": len(group)}
            for policy in self.policies:
                mean, low, high = mean_interval(group[f"{policy}_lifetime"].to_numpy())
                row |= {policy: mean, f"{policy}_low": low, f"{policy}_high": high}
                row[f"{policy}_max"] = float(group[f"{policy}_lifetime"].max())
                row[f"{policy}_fixed"] = float(group[f"{policy}_lifetime_fixed"].mean())
                share = self.first_failures(policy)[group.index].mean(axis=0)
                row |= _first_to_fail(policy, share)
            for policy in self._over_oldest:
                paired = (group[f"{policy}_lifetime"] - group["oldest_first_lifetime"]).to_numpy()
                names = (f"{policy}_over_oldest", f"{policy}_over_oldest_low", f"{policy}_over_oldest_high")
                row |= dict(zip(names, mean_interval(paired), strict=True))
            for name in group.columns[group.columns.str.endswith("_planned")]:
                row[name] = float(group[name].mean())
            for planner in (name for name in PLANNERS if f"{name}/first_failure" in self.evaluation):
                share = self.evaluation[f"{planner}/first_failure"][group.index].mean(axis=(0, 1))
                row |= _first_to_fail(planner, share)
            for upper, lower in self.gaps:
                paired = (group[f"{upper}_planned"] - group[f"{lower}_planned"]).to_numpy()
                names = (f"{upper}_over_{lower}", f"{upper}_over_{lower}_low", f"{upper}_over_{lower}_high")
                row |= dict(zip(names, mean_interval(paired), strict=True))
            rows.append(row)
        return pd.DataFrame(rows)

    def first_failures(self, policy: str) -> np.ndarray:
        """``[A, n]`` how often each device of each agent's layout is the first to fail, over the held-out draws.

        A planner played the first few of them; a policy all, and the fixed draw behind them.
        """
        episodes = self.evaluation[f"{policy}/first_failure"]
        return np.asarray((episodes if policy in PLANNERS else episodes[:, :-1]).mean(axis=1))

    def save(self, directory: Path) -> None:
        """Write every file of the run into ``directory``, each atomically; ``run.json`` last."""
        directory.mkdir(parents=True, exist_ok=True)
        write_text(directory / _STUDY, study_toml(self.study))
        write_text(directory / _AGENTS, self.agents.to_csv(index=False, float_format="%.6g"))
        for name, arrays in (
            (_CURVES, traverse_util.flatten_dict(self.curves, sep="/")),
            (_EVALUATION, self.evaluation),
        ):
            if arrays:  # nothing was trained: no curves, no weights
                write_arrays(directory / name, arrays)
        if self.weights:
            write_collection(directory / WEIGHTS, self._collection())
        write_text(directory / _RUN, json.dumps(self.run, indent=1) + "\n")

    def _collection(self) -> Collection:
        """The weights with all that is needed to make policies of them."""
        axes = ["seed", *cell_axes(self.study)]
        agents: dict[str, list[dict[str, Any]]] = {}
        for row in json.loads(self.agents[axes].to_json(orient="records", double_precision=15)):
            row |= {"place": self.study.place} if self.study.place else {}
            agents.setdefault(row.get("algorithm", self.study.algorithm), []).append(row)
        return Collection(
            settings={name: getattr(self.study, name).model_dump(mode="json") for name in self.study.algorithms},
            n_devices=self.study.params.n_devices,
            agents=agents,
            weights=self.weights,
        )


def _append(mine: dict[str, np.ndarray], theirs: Mapping[str, Any]) -> None:
    """Arrays with an axis of agents grow by those of a block; the steps of curves are shared by all."""
    for name, values in theirs.items():
        grows = name in mine and not name.endswith("_steps")
        mine[name] = np.concatenate([mine[name], values]) if grows else np.asarray(values)


def _first_to_fail(policy: str, share: np.ndarray) -> dict[str, Any]:
    """The device (from 1, 0 for none) that is first most often, of ``share [n]``."""
    return {f"{policy}_first_device": device_number(share), f"{policy}_first_share": float(share.max())}


def holds_run(directory: Path) -> bool:
    """Whether a folder holds a run."""
    return (directory / _RUN).exists() or (directory / _STUDY).exists()


def load_results(directory: str | Path) -> Results:
    """Read a run back (all but its weights, see :func:`load_weights`).

    Raises:
        StudyError: the folder holds no run, a file of it is damaged, or it was written by a newer version.
    """
    directory = Path(directory)
    run = _read_run(directory)
    try:
        agents = _read_table(directory / _AGENTS)
    except (OSError, ValueError) as error:
        raise StudyError(f"{directory}: cannot be read: {error}") from None
    study = load_study(directory / _STUDY)
    return Results(
        study=study,
        run=run,
        agents=agents,
        curves=_nested_curves(directory / _CURVES, run.get("schema", 1)) if study.algorithms else {},
        evaluation=load_arrays(directory / _EVALUATION),
    )


def _read_run(directory: Path) -> dict[str, Any]:
    """What ``run.json`` holds."""
    path = directory / _RUN
    if not path.is_file():
        raise StudyError(f"{directory}: holds no run ({_RUN} is not there)")
    try:
        run: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise StudyError(f"{directory}: cannot be read: {error}") from None
    if run.get("schema", SCHEMA) > SCHEMA:
        raise StudyError(f"{path}: schema is {run['schema']}; this version reads up to {SCHEMA}")
    return run


def _read_table(path: Path) -> pd.DataFrame:
    """The tidy table; lists of device numbers stay text, also where they are empty or one number."""
    lists = {name: str for name in pd.read_csv(path, nrows=0).columns if name.endswith("_devices_fixed")}
    return pd.read_csv(path, dtype=lists, keep_default_na=False)


def load_weights(directory: str | Path, which: str = "best", algorithm: str | None = None) -> dict[str, Any]:
    """Trained weights of a run as the networks take them, leaves ``[A, ...]`` in the order of ``agents.csv``.

    Args:
        directory: of the run.
        which: ``"best"`` or ``"last"``.
        algorithm: whose agents; by default the first algorithm of the run.

    Raises:
        PolicyError: there are none, or the file is damaged.
    """
    return read_collection(Path(directory) / WEIGHTS).weights_of(which, algorithm)


def _nested_curves(path: Path, schema: int) -> dict[str, Any]:
    """Curves by algorithm."""
    nested: dict[str, Any] = traverse_util.unflatten_dict(load_arrays(path), sep="/")
    return nested if schema > 1 else {"dqn": nested}

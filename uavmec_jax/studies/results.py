"""Results of a run: the tidy table, curves, evaluation and weights, and their files."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from flax import traverse_util
from jaxtyping import Float

from uavmec_jax.errors import StudyError
from uavmec_jax.files.locations import make_folder, reached
from uavmec_jax.files.reading import digest_of
from uavmec_jax.files.writing import write_arrays, write_text
from uavmec_jax.scenarios.policy_files import WEIGHTS, PolicyCollection, write_policies
from uavmec_jax.scenarios.settings import unused_params
from uavmec_jax.studies.evaluation_result import MISSING, most_common_first_device
from uavmec_jax.studies.measures import with_measures
from uavmec_jax.studies.parts import split_study
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.schema import PLANNERS, Study
from uavmec_jax.studies.shard_result import ShardResult, total_seconds
from uavmec_jax.studies.statistics import mean_interval
from uavmec_jax.studies.study import study_toml

SCHEMA = 3
"""Version of the files of a run."""

STUDY, RUN, AGENTS, CURVES, EVALUATION = "study.toml", "run.json", "agents.csv", "curves.npz", "evaluation.npz"


@dataclass
class Results:
    """Results of a run, which may not be complete yet.

    Attributes:
        study: the resolved study.
        run: contents of ``run.json``: versions, hardware, command, seeds, times, speed.
        agents: tidy table, one row per finished agent.
        curves: per algorithm, of its agents: ``chunk_steps [C]``, ``episode_length [A, C]``, ``validation_steps [V]``,
            ``validation [A, V]``.
        evaluation: per policy ``<name>/lifetime [A, E]``, ``/cause [A, E]``, ``/first_failure [A, E, n]``, with a horizon
            ``/service_s [A, E]``, the fixed draw last; per planner the same with ``P`` held-out draws in place of ``E``, of
            the bound the lifetimes only. Planners that were not evaluated for an agent have :data:`MISSING` and NaN.
        weights: ``<algorithm>/best/...`` and ``<algorithm>/last/...``, leaves ``[A, ...]`` of its agents; empty when
            read back by :func:`load_results`.
    """

    study: Study
    run: dict[str, Any]
    agents: pd.DataFrame = field(default_factory=pd.DataFrame)
    curves: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    evaluation: dict[str, np.ndarray] = field(default_factory=dict)
    weights: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def policies(self) -> list[str]:
        """Names of the policies in the table, as in its columns."""
        return [name.removesuffix("_lifetime") for name in self.agents.columns if name.endswith("_lifetime")]

    @property
    def shown(self) -> str:
        """Policy that tables show: the best weights; if nothing was trained, earliest-deadline or another heuristic."""
        preferred = ("best", "earliest_deadline", *self.policies, *PLANNERS)
        return next((name for name in preferred if f"{name}_first_device" in self.agents), "bound")

    @property
    def gaps(self) -> list[tuple[str, str]]:
        """Pairs ``(upper, lower)`` of neighbours in the order: shown policy, planners, upper bound."""
        return list(zip(self.ladder[1:], self.ladder, strict=False))

    @property
    def ladder(self) -> list[str]:
        """The shown policy, planners and upper bound, as far as some agent was evaluated on the planners' draws."""
        columns = {name: f"{name}_planned" for name in (self.shown, *PLANNERS)}
        return [name for name, column in columns.items() if column in self.agents and self.agents[column].notna().any()]

    @classmethod
    def of(cls, study: Study, label: Mapping[str, Any], shards: Iterable[ShardResult], agents: int) -> "Results":
        """Combine the results of finished shards.

        Args:
            study: the resolved study.
            label: facts about the run, for ``run.json``.
            shards: results of the finished shards, in the order of the run plan.
            agents: number of agents in the whole study.
        """
        results, shards = cls(study, dict(label), agents=_no_agents(study)), list(shards)
        curves: dict[str, list[Mapping]] = {}
        weights = []
        for shard in shards:
            if shard.curves:
                curves.setdefault(shard.algorithm, []).append(shard.curves)
                weights.append(traverse_util.flatten_dict({shard.algorithm: shard.weights}, sep="/"))
        results.curves = {name: _concatenate(pieces) for name, pieces in curves.items()}
        results.evaluation = _concatenate([shard.evaluation for shard in shards])
        results.weights = _concatenate(weights)
        if shards:
            rows = pd.concat([shard.rows for shard in shards], ignore_index=True)
            results.agents = with_measures(study, rows, results.evaluation)
        processors = {shard.processor for shard in shards}
        if processors - {results.run.get("processor")}:
            results.run["processors"] = sorted(processors)  # bits are promised for one model
        results._add_totals(agents, sum(shard.steps for shard in shards), total_seconds(shards))
        return results

    def _add_totals(self, agents: int, steps: int, seconds: dict[str, float]) -> None:
        """Add totals over the finished shards to ``run``; seconds are sums over all shards, except for the wall time."""
        self.run |= {
            "complete": len(self.agents) == agents,
            "agents_done": len(self.agents),
            "seconds": {name: round(spent, 2) for name, spent in seconds.items()},
        }
        if steps:
            self.run |= {
                "diverged": int((self.agents["diverged_at"] >= 0).sum()),
                "environment_steps": steps,
                "training_steps_per_second": round(steps / seconds["train"]),
                "validation_share": round(seconds["validate"] / (seconds["train"] + seconds["validate"]), 4),
                "checkpoint_share": round(seconds.get("checkpoint", 0.0) / seconds["train"], 4),
            }

    def parts(self) -> dict[str, "Results"]:
        """Return the results of each part of the study, see :class:`Part`, by its name, without curves and weights."""
        parts = {}
        for part in split_study(self.study):
            there = np.ones(len(self.agents), bool)
            for axis, value in part.values.items():
                there &= (self.agents[axis] == value).to_numpy(bool)
            agents = self.agents[there].drop(columns=list(part.values)).reset_index(drop=True)
            evaluation = {name: array[there] for name, array in self.evaluation.items()}
            parts[part.name] = Results(part.study, self.run, agents=agents, evaluation=evaluation)
        return parts

    def cells(self) -> pd.DataFrame:
        """Return one row per cell: means and intervals over seeds, paired differences, and the device that fails first."""
        axes = cell_axes(self.study)
        return pd.DataFrame(
            dict(zip(axes, cell, strict=True)) | {"seeds": len(group)} | self._cell(group)
            for cell, group in self.agents.groupby(axes, sort=False)
        )

    def agents_of(self, cell: Any) -> pd.DataFrame:
        """Return the agents of a cell, which is a row of :meth:`cells`."""
        axes = cell_axes(self.study)
        return self.agents[np.logical_and.reduce([self.agents[axis] == cell[axis] for axis in axes])]

    def _cell(self, agents: pd.DataFrame) -> dict[str, Any]:
        """Return the row of one cell without its axes."""
        row: dict[str, Any] = {}
        for policy in self.policies:
            lifetimes = agents[f"{policy}_lifetime"]
            row |= _interval_columns(policy, lifetimes)
            row[f"{policy}_max"] = float(lifetimes.max())
            row[f"{policy}_fixed"] = float(agents[f"{policy}_lifetime_fixed"].mean())
            row |= _first_failure_columns(policy, self.first_failures(policy)[agents.index].mean(axis=0))
        for policy in (name for name in ("best", "last") if {name, "oldest_first"} <= set(self.policies)):
            difference = agents[f"{policy}_lifetime"] - agents["oldest_first_lifetime"]
            row |= _interval_columns(f"{policy}_over_oldest", difference)
        for name in agents.columns[agents.columns.str.endswith("_planned")]:
            row[name] = float(agents[name].mean())
        for planner in (name for name in PLANNERS if f"{name}/first_failure" in self.evaluation):
            shares = self.evaluation[f"{planner}/first_failure"][agents.index]
            evaluated = shares[~np.isnan(shares).any(axis=(1, 2))]
            row |= _first_failure_columns(planner, evaluated.mean(axis=(0, 1)) if len(evaluated) else shares[0, 0])
        for upper, lower in self.gaps:
            difference = agents[f"{upper}_planned"] - agents[f"{lower}_planned"]
            row |= _interval_columns(f"{upper}_over_{lower}", difference)
        for name in agents.columns[agents.columns.str.endswith(("_service", "_censored"))]:
            row[name] = float(agents[name].mean())
        return row

    def curve_table(self) -> pd.DataFrame:
        """Return all curves as a tidy table: the agent's axes, ``steps``, ``curve`` and ``value``.

        ``curve`` is ``episode_length`` or ``validation``.
        """
        tables = []
        for name, curves in self.curves.items():
            agents = self._agent_axes(self.agents["algorithm"] == name if "algorithm" in self.agents else slice(None))
            for curve, x in (("episode_length", "chunk_steps"), ("validation", "validation_steps")):
                table = _repeat_rows(agents, len(curves[x]))
                steps = np.tile(curves[x], len(agents))
                tables.append(table.assign(steps=steps, curve=curve, value=curves[curve].ravel()))
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()

    def episode_table(self) -> pd.DataFrame:
        """Return all episodes as a tidy table: the agent's axes, ``policy``, ``draw``, ``fixed`` and ``lifetime`` (slots).

        ``fixed`` says whether the draw is the one that is the same for every agent. Episodes that were not evaluated are
        left out.
        """
        agents, tables = self._agent_axes(slice(None)), []
        for name, lifetimes in self.evaluation.items():
            policy, _, field_name = name.partition("/")
            if field_name != "lifetime":
                continue
            draws = lifetimes.shape[1]
            draw = np.tile(np.arange(draws), len(agents))
            fixed = (draw == draws - 1) & (policy not in PLANNERS)
            table = _repeat_rows(agents, draws)
            table = table.assign(policy=policy, draw=draw, fixed=fixed, lifetime=lifetimes.ravel())
            tables.append(table[table["lifetime"] != MISSING])
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()

    def _agent_axes(self, which: Any) -> pd.DataFrame:
        """Return the values of some agents on all axes."""
        return self.agents.loc[which, ["seed", *cell_axes(self.study)]].reset_index(drop=True)

    def first_failures(self, policy: str) -> Float[np.ndarray, "A n"]:
        """Return each agent's share of held-out episodes in which each device is the first to fail.

        A planner's episodes are its first few held-out draws; a policy's are all of them, followed by the fixed draw. Agents
        for which a planner was not evaluated have NaN.
        """
        episodes = self.evaluation[f"{policy}/first_failure"]
        return np.asarray((episodes if policy in PLANNERS else episodes[:, :-1]).mean(axis=1))

    def save(self, directory: str | Path) -> None:
        """Write all files into a folder, each atomically; ``run.json``, with the SHA-256 of the others, comes last.

        Raises:
            OSError: a file cannot be written.
            StudyError: the folder is a URL, and its object store cannot be reached or written to.
        """
        with reached(directory) as path:
            self._save(path)

    def _save(self, directory: Path) -> None:
        make_folder(directory)
        write_text(directory / STUDY, study_toml(self.study))
        if len(self.agents):
            write_text(directory / AGENTS, self.agents.to_csv(index=False, float_format="%.6g"))
        for name, arrays in (
            (CURVES, traverse_util.flatten_dict(self.curves, sep="/")),
            (EVALUATION, self.evaluation),
        ):
            if arrays:  # a study that trains nothing has no curves and no weights
                write_arrays(directory / name, arrays)
        if self.weights:
            write_policies(directory / WEIGHTS, self._collection())
        written = [directory / name for name in (STUDY, AGENTS, CURVES, EVALUATION, WEIGHTS)]
        digests = {file.name: digest_of(file, StudyError) for file in written if file.exists()}
        write_text(directory / RUN, json.dumps(self.run | {"sha256": digests}, indent=1) + "\n")

    def _collection(self) -> PolicyCollection:
        """Return the weights with all that is needed to make policies of them."""
        agents: dict[str, list[dict[str, Any]]] = {name: [] for name in self.study.algorithms}
        axes = self.agents[["seed", *cell_axes(self.study)]]
        for row in json.loads(axes.to_json(orient="records", double_precision=15)):
            agents[row.get("algorithm", self.study.algorithm)].append(row)
        finished = {name: agent_ids for name, agent_ids in agents.items() if agent_ids}
        return policy_collection(self.study, finished, self.weights)


def _no_agents(study: Study) -> pd.DataFrame:
    """Return the tidy table of no agents."""
    return pd.DataFrame(columns=["seed", *cell_axes(study)])


def _concatenate(pieces: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Concatenate arrays along the axis of agents; the steps of curves, which all agents share, are taken once."""
    by_name: dict[str, list[np.ndarray]] = {}
    for piece in pieces:
        for name, values in piece.items():
            by_name.setdefault(name, []).append(np.asarray(values))
    return {name: arrays[0] if name.endswith("_steps") else np.concatenate(arrays) for name, arrays in by_name.items()}


def _repeat_rows(table: pd.DataFrame, times: int) -> pd.DataFrame:
    """Repeat every row of a table."""
    return table.loc[table.index.repeat(times)].reset_index(drop=True)


def _interval_columns(name: str, values: pd.Series) -> dict[str, float]:
    """Return a mean with its 95 % interval as columns; values that are missing are left out."""
    known = values.dropna().to_numpy()
    interval = mean_interval(known) if len(known) else (math.nan,) * 3
    return dict(zip((name, f"{name}_low", f"{name}_high"), interval, strict=True))


def _first_failure_columns(policy: str, share: Float[np.ndarray, " n"]) -> dict[str, Any]:
    """Return the device that fails first most often, and its share of first failures, as columns."""
    return {f"{policy}_first_device": most_common_first_device(share), f"{policy}_first_share": float(share.max())}


def _drawn(study: Study) -> dict[str, Any]:
    """Return the settings that scenarios are drawn from, for JSON; infinite numbers, which it lacks, are left out."""
    if study.scenarios is None:
        return {}
    settings = study.params.model_dump(exclude=unused_params(study.params))
    params = {name: value for name, value in settings.items() if value != math.inf}
    return {"scenarios": study.scenarios.model_dump(mode="json"), "params": params}


def policy_collection(
    study: Study, agents: Mapping[str, list[dict[str, Any]]], weights: Mapping[str, Any]
) -> PolicyCollection:
    """Make a collection of the policies of a study's agents.

    Args:
        study: the study.
        agents: algorithm -> identities of the agents.
        weights: weights by algorithm and ``best`` or ``last``, nested or flattened with ``/``.
    """
    place = {"place": study.place} if study.place else {}
    return PolicyCollection(
        settings={name: getattr(study, name).model_dump(mode="json") for name in agents},
        n_devices=study.params.n_devices,
        agents={name: [dict(agent_id) | place for agent_id in agent_ids] for name, agent_ids in agents.items()},
        weights=traverse_util.flatten_dict(dict(weights), sep="/"),
        drawn=_drawn(study),
    )

"""What a run leaves: files that are read back without pickle, each written whole or not at all."""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from flax import traverse_util

from uavmec_jax.files.writing import write_arrays, write_text
from uavmec_jax.scenarios.policy_files import WEIGHTS, PolicyCollection, write_policies
from uavmec_jax.studies.evaluation import device_number
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.schema import PLANNERS, Study
from uavmec_jax.studies.shard_result import ShardResult
from uavmec_jax.studies.statistics import mean_interval
from uavmec_jax.studies.study import study_toml

SCHEMA = 3
"""Version of the run folder."""

STUDY, RUN, AGENTS, CURVES, EVALUATION = "study.toml", "run.json", "agents.csv", "curves.npz", "evaluation.npz"


@dataclass
class Results:
    """One run, whole or as far as it got.

    Attributes:
        study: the resolved study.
        run: what ``run.json`` holds: versions, hardware, command, seeds, times, speed.
        agents: tidy table, one row per finished agent.
        curves: per algorithm, of its agents: ``chunk_steps [C]``, ``episode_length [A, C]``, ``validation_steps [L]``,
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

    @classmethod
    def of(cls, study: Study, label: Mapping[str, Any], shards: Iterable[ShardResult], agents: int) -> "Results":
        """Put finished shards together, in the order of the plan.

        Args:
            study: the resolved study.
            label: of the run.
            shards: those that are finished.
            agents: how many there are when all are finished.
        """
        made = cls(study, dict(label))
        seconds: dict[str, float] = {}
        rows: list[pd.DataFrame] = []
        curves: dict[str, list[Mapping]] = {}
        evaluation, weights = [], []
        steps = 0
        for shard in shards:
            rows.append(shard.rows)
            evaluation.append(shard.evaluation)
            if shard.curves:
                curves.setdefault(shard.algorithm, []).append(shard.curves)
                weights.append(traverse_util.flatten_dict({shard.algorithm: shard.weights}, sep="/"))
            steps += shard.steps
            for activity, spent in shard.seconds.items():
                seconds[activity] = seconds.get(activity, 0.0) + spent
        made.agents = pd.concat(rows, ignore_index=True) if rows else pd.DataFrame()
        made.curves = {name: _joined(own) for name, own in curves.items()}
        made.evaluation, made.weights = _joined(evaluation), _joined(weights)
        made._measure(agents, steps, seconds)
        return made

    def _measure(self, agents: int, steps: int, seconds: dict[str, float]) -> None:
        """Add to the label what the finished shards took: seconds of all workers together, but for the wall time."""
        seconds = seconds | {"wall": seconds.get("wall", 0.0) / self.run.get("workers", 1)}
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

    def curve_table(self) -> pd.DataFrame:
        """Tidy: the agent's axes, ``steps``, ``curve`` (``episode_length`` or ``validation``), ``value``."""
        tables = []
        for name, curves in self.curves.items():
            who = self._who(self.agents["algorithm"] == name if "algorithm" in self.agents else slice(None))
            for curve, steps in (("episode_length", "chunk_steps"), ("validation", "validation_steps")):
                n = len(curves[steps])
                table = who.loc[who.index.repeat(n)].reset_index(drop=True)
                tables.append(
                    table.assign(steps=np.tile(curves[steps], len(who)), curve=curve, value=curves[curve].ravel())
                )
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()

    def episode_table(self) -> pd.DataFrame:
        """Tidy: the agent's axes, ``policy``, ``draw``, whether it is the ``fixed`` one, ``lifetime`` in slots."""
        who, tables = self._who(slice(None)), []
        for name, lives in self.evaluation.items():
            policy, _, what = name.partition("/")
            if what != "lifetime":
                continue
            draw = np.tile(np.arange(lives.shape[1]), len(who))
            table = who.loc[who.index.repeat(lives.shape[1])].reset_index(drop=True)
            fixed = (draw == lives.shape[1] - 1) & (policy not in PLANNERS)
            tables.append(table.assign(policy=policy, draw=draw, fixed=fixed, lifetime=lives.ravel()))
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()

    def _who(self, which: Any) -> pd.DataFrame:
        """The axes of some agents."""
        return self.agents.loc[which, ["seed", *cell_axes(self.study)]].reset_index(drop=True)

    def first_failures(self, policy: str) -> np.ndarray:
        """``[A, n]`` how often each device of each agent's layout is the first to fail, over the held-out draws.

        A planner played the first few of them; a policy all, and the fixed draw behind them.
        """
        episodes = self.evaluation[f"{policy}/first_failure"]
        return np.asarray((episodes if policy in PLANNERS else episodes[:, :-1]).mean(axis=1))

    def save(self, directory: Path) -> None:
        """Write every file of the run into ``directory``, each atomically; ``run.json``, with their SHA-256, last."""
        directory.mkdir(parents=True, exist_ok=True)
        write_text(directory / STUDY, study_toml(self.study))
        if len(self.agents):
            write_text(directory / AGENTS, self.agents.to_csv(index=False, float_format="%.6g"))
        for name, arrays in (
            (CURVES, traverse_util.flatten_dict(self.curves, sep="/")),
            (EVALUATION, self.evaluation),
        ):
            if arrays:  # nothing was trained: no curves, no weights
                write_arrays(directory / name, arrays)
        if self.weights:
            write_policies(directory / WEIGHTS, self._collection())
        written = [directory / name for name in (STUDY, AGENTS, CURVES, EVALUATION, WEIGHTS)]
        digests = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in written if file.exists()}
        write_text(directory / RUN, json.dumps(self.run | {"sha256": digests}, indent=1) + "\n")

    def _collection(self) -> PolicyCollection:
        """The weights with all that is needed to make policies of them."""
        agents: dict[str, list[dict[str, Any]]] = {name: [] for name in self.study.algorithms}
        axes = self.agents[["seed", *cell_axes(self.study)]]
        for row in json.loads(axes.to_json(orient="records", double_precision=15)):
            agents[row.get("algorithm", self.study.algorithm)].append(row)
        finished = {name: own for name, own in agents.items() if own}
        return policy_collection(self.study, finished, self.weights)


def _joined(pieces: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Arrays with an axis of agents, one after the other; the steps of curves are shared by all."""
    found: dict[str, list[np.ndarray]] = {}
    for piece in pieces:
        for name, values in piece.items():
            found.setdefault(name, []).append(np.asarray(values))
    return {name: own[0] if name.endswith("_steps") else np.concatenate(own) for name, own in found.items()}


def _first_to_fail(policy: str, share: np.ndarray) -> dict[str, Any]:
    """The device (from 1, 0 for none) that is first most often, of ``share [n]``."""
    return {f"{policy}_first_device": device_number(share), f"{policy}_first_share": float(share.max())}


def _drawn(study: Study) -> dict[str, Any]:
    """What scenarios were drawn from, as plain data; infinite numbers, which JSON has no word for, are left out."""
    if study.scenarios is None:
        return {}
    params = {name: value for name, value in study.params.model_dump().items() if value != math.inf}
    return {"scenarios": study.scenarios.model_dump(mode="json"), "params": params}


def policy_collection(
    study: Study, agents: Mapping[str, list[dict[str, Any]]], weights: Mapping[str, Any]
) -> PolicyCollection:
    """Agents of a study as a collection of policies, ``weights`` by algorithm and kind: nested, or flat with ``/``."""
    place = {"place": study.place} if study.place else {}
    return PolicyCollection(
        settings={name: getattr(study, name).model_dump(mode="json") for name in agents},
        n_devices=study.params.n_devices,
        agents={name: [dict(who) | place for who in own] for name, own in agents.items()},
        weights=traverse_util.flatten_dict(dict(weights), sep="/"),
        drawn=_drawn(study),
    )

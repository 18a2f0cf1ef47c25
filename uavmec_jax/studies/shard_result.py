"""Results of one finished shard, in one checked file: rows, curves, evaluation and weights."""

import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from flax import traverse_util
from pydantic import Field

from uavmec_jax.errors import StudyError
from uavmec_jax.files.archives import read_checked, write_checked
from uavmec_jax.files.parsing import MAX_COLUMNS
from uavmec_jax.files.validation import StrictModel, validated
from uavmec_jax.studies.parts import PART_AXES
from uavmec_jax.studies.results_checks import check_agents, check_curves, check_evaluation
from uavmec_jax.studies.schema import Study
from uavmec_jax.training import host

SHARD_SCHEMA = 2
"""Version of the file format."""

_NUMBERS = "biuf"
"""Kinds of NumPy dtypes that are stored as they are; other columns are stored as text."""


_Seconds = Annotated[float, Field(ge=0)]


class ShardFacts(StrictModel):
    """The header of the file."""

    version: Annotated[int, Field(alias="schema")]
    package: str
    algorithm: str
    seconds: dict[str, _Seconds]
    steps: Annotated[int, Field(ge=0, le=2**62)]
    columns: Annotated[list[str], Field(min_length=1, max_length=MAX_COLUMNS)]
    ended_at: _Seconds
    processor: str


@dataclass(frozen=True)
class ShardResult:
    """Results of a shard whose agents are trained and evaluated.

    Attributes:
        algorithm: name of the algorithm.
        rows: tidy table, one row per agent.
        curves, evaluation, weights: as in :class:`uavmec_jax.studies.results.Results`, of this shard alone.
        seconds: time spent, by activity.
        steps: environment steps of all agents together.
        ended_at: when it was finished, in seconds since the epoch.
        processor: name of the processor that did the work.
    """

    algorithm: str
    rows: pd.DataFrame
    curves: dict[str, Any]
    evaluation: dict[str, Any]
    weights: dict[str, Any]
    seconds: dict[str, float]
    steps: int
    ended_at: float = field(default_factory=time.time)
    processor: str = field(default_factory=host.processor)

    @property
    def worked(self) -> tuple[float, float]:
        """When the attempt that finished it began and ended, in seconds since the epoch."""
        return self.ended_at - self.seconds.get("wall", 0.0), self.ended_at

    def write(self, path: Path) -> None:
        """Write the results into one checked file, atomically."""
        trees = {"curves": self.curves, "evaluation": self.evaluation, "weights": self.weights}
        columns = {
            f"rows/{name}": column.to_numpy(dtype=None if column.dtype.kind in _NUMBERS else str)
            for name, column in self.rows.items()
        }
        arrays = columns | {
            f"{kind}/{name}": np.asarray(leaf)
            for kind, tree in trees.items()
            for name, leaf in traverse_util.flatten_dict(tree, sep="/").items()
        }
        facts = {"algorithm": self.algorithm, "seconds": self.seconds, "steps": self.steps}
        facts |= {"columns": [*self.rows], "ended_at": self.ended_at, "processor": self.processor}
        write_checked(path, SHARD_SCHEMA, facts, arrays, compressed=False)

    @classmethod
    def read(cls, path: Path) -> "ShardResult":
        """Read what :meth:`write` wrote.

        Raises:
            StudyError: the file is missing, damaged, altered, of another kind or from another version.
        """
        header, arrays = read_checked(path, SHARD_SCHEMA, "a finished shard", StudyError)
        facts = validated(ShardFacts, header, path, StudyError)

        def arrays_of(kind: str) -> dict[str, np.ndarray]:
            return {name.removeprefix(f"{kind}/"): leaf for name, leaf in arrays.items() if name.startswith(f"{kind}/")}

        weights = arrays_of("weights")
        if inside := [name for name in weights if any(f"{name}/" == other[: len(name) + 1] for other in weights)]:
            raise StudyError(f"{path}: array 'weights/{inside[0]}' is both an array and the folder of other arrays")
        return cls(
            algorithm=facts.algorithm,
            rows=_table(path, facts.columns, arrays_of("rows")),
            curves=arrays_of("curves"),
            evaluation=arrays_of("evaluation"),
            weights=traverse_util.unflatten_dict(weights, sep="/"),
            seconds=dict(facts.seconds),
            steps=facts.steps,
            ended_at=facts.ended_at,
            processor=facts.processor,
        )

    def check(self, study: Study, ids: Sequence[Mapping[str, Any]], source: object) -> None:
        """Check that these are the results of the agents with these identities.

        Args:
            study: the study of the shard's part alone.
            ids: identities of the shard's agents in the whole study.
            source: names the file in messages.

        Raises:
            StudyError: agents, columns, arrays or their values are not those that the study gives.
        """
        if self.algorithm != study.algorithm:
            raise StudyError(f"{source}: belongs to another shard: its algorithm is {self.algorithm[:40]!r}")
        axes = {name: [agent_id[name] for agent_id in ids] for name in ids[0]}
        if any(name not in self.rows or self.rows[name].tolist() != values for name, values in axes.items()):
            raise StudyError(f"{source}: belongs to another shard: its agents are not those of this one")
        if self.steps and not (self.seconds.get("train", 0.0) > 0 and "validate" in self.seconds):
            raise StudyError(f"{source}: seconds are {self.seconds}; train should be above 0, and validate be there")
        parts = [name for name in PART_AXES if name in axes and name not in study.axes]
        check_agents(study, self.rows.drop(columns=parts), source)
        check_evaluation(study, len(ids), self.evaluation, source)
        curves = {f"{self.algorithm}/{name}": values for name, values in self.curves.items()}
        check_curves(study, {name: len(ids) for name in study.algorithms}, curves, source)
        weights = traverse_util.flatten_dict(self.weights, sep="/")
        for name, leaf in weights.items():
            if leaf.dtype.kind != "f" or leaf.shape[:1] != (len(ids),):
                raise StudyError(f"{source}: array 'weights/{name}' should hold the numbers of {len(ids)} agents")
        kinds, given = {name.partition("/")[0] for name in weights}, {"best", "last"} if study.algorithms else set()
        if kinds != given:
            found, expected = (", ".join(sorted(names)) or "none" for names in (kinds, given))
            raise StudyError(f"{source}: has the weights {found}; the study gives {expected}")


def _table(path: Path, names: list[str], columns: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """Return the tidy table with these columns."""
    rows = {}
    for name in names:
        if name not in columns:
            raise StudyError(f"{path}: has no array 'rows/{name}'")
        column = columns[name]
        if column.ndim != 1 or len(column) != len(columns[names[0]]):
            raise StudyError(f"{path}: array 'rows/{name}' has the shape {column.shape}; all columns have one length")
        rows[name] = column if column.dtype.kind in _NUMBERS else column.tolist()
    return pd.DataFrame(rows)


def total_seconds(shards: Iterable[ShardResult]) -> dict[str, float]:
    """Return the seconds of all shards by activity; ``wall`` is the time in which at least one of them was worked on."""
    shards = list(shards)
    totals: Counter[str] = Counter()
    for shard in shards:
        totals.update(shard.seconds)
    wall, until = 0.0, float("-inf")
    for first, last in sorted(shard.worked for shard in shards):
        wall += max(last - max(first, until), 0.0)
        until = max(until, last)
    return {**totals, "wall": wall}

"""Results of one finished shard, in one checked file: rows, curves, evaluation and weights."""

import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from flax import traverse_util

from uavmec_jax.errors import StudyError
from uavmec_jax.files.archives import read_checked, write_checked
from uavmec_jax.training import host

SHARD_SCHEMA = 2
"""Version of the file format."""

_NUMBERS = "biuf"
"""Kinds of NumPy dtypes that are stored as they are; other columns are stored as text."""


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
        facts, arrays = read_checked(path, SHARD_SCHEMA, "a finished shard", StudyError)

        def arrays_of(kind: str) -> dict[str, np.ndarray]:
            return {name.removeprefix(f"{kind}/"): leaf for name, leaf in arrays.items() if name.startswith(f"{kind}/")}

        columns = arrays_of("rows")
        rows = {
            name: columns[name] if columns[name].dtype.kind in _NUMBERS else columns[name].tolist()
            for name in facts["columns"]
        }
        return cls(
            algorithm=facts["algorithm"],
            rows=pd.DataFrame(rows),
            curves=arrays_of("curves"),
            evaluation=arrays_of("evaluation"),
            weights=traverse_util.unflatten_dict(arrays_of("weights"), sep="/"),
            seconds=facts["seconds"],
            steps=facts["steps"],
            ended_at=facts["ended_at"],
            processor=facts["processor"],
        )


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

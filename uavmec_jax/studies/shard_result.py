"""Results of one finished shard, in one checked file: rows, curves, evaluation and weights."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from flax import traverse_util

from uavmec_jax.errors import StudyError
from uavmec_jax.files.archives import read_checked, write_checked

SHARD_SCHEMA = 1
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
    """

    algorithm: str
    rows: pd.DataFrame
    curves: dict[str, Any]
    evaluation: dict[str, Any]
    weights: dict[str, Any]
    seconds: dict[str, float]
    steps: int

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
        facts = {"algorithm": self.algorithm, "seconds": self.seconds, "steps": self.steps, "columns": [*self.rows]}
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
        )

"""What one finished shard leaves: rows, curves, evaluation and weights, in one checked file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from flax import traverse_util

from uavmec_jax.errors import StudyError
from uavmec_jax.files.archives import read_checked, write_checked

SHARD_SCHEMA = 1
"""Version of a finished shard's file."""


@dataclass(frozen=True)
class ShardResult:
    """A shard that is trained and judged.

    Attributes:
        algorithm: its name.
        rows: tidy table, one row per agent.
        curves, evaluation, weights: see :class:`uavmec_jax.studies.results.Results`.
        seconds: by activity.
        steps: environment steps of all its agents.
    """

    algorithm: str
    rows: pd.DataFrame
    curves: dict[str, Any]
    evaluation: dict[str, Any]
    weights: dict[str, Any]
    seconds: dict[str, float]
    steps: int

    def write(self, path: Path) -> None:
        """Into one checked file, whole or not at all."""
        trees = {"curves": self.curves, "evaluation": self.evaluation, "weights": self.weights}
        columns = {
            f"rows/{name}": column.to_numpy() if column.dtype.kind in "biuf" else column.to_numpy(dtype=str)
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
        """What :meth:`write` wrote.

        Raises:
            StudyError: the file is not there, damaged, altered, something else or of another version.
        """
        facts, arrays = read_checked(path, SHARD_SCHEMA, "a finished shard", StudyError)

        def of(kind: str) -> dict[str, Any]:
            return {name.removeprefix(f"{kind}/"): leaf for name, leaf in arrays.items() if name.startswith(f"{kind}/")}

        found = of("rows")
        rows = {
            name: found[name] if found[name].dtype.kind in "biuf" else found[name].tolist() for name in facts["columns"]
        }
        return cls(
            algorithm=facts["algorithm"],
            rows=pd.DataFrame(rows),
            curves=of("curves"),
            evaluation=of("evaluation"),
            weights=traverse_util.unflatten_dict(of("weights"), sep="/"),
            seconds=facts["seconds"],
            steps=facts["steps"],
        )

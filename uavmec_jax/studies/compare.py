"""Two runs side by side: paired differences, interquartile mean, probability of improvement.

The last two as Agarwal et al. (2021), "Deep reinforcement learning at the edge of the statistical precipice", define them
and their library rliable computes them: a cell is a task, a seed is a run.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from uavmec_jax.errors import StudyError
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.statistics import CONFIDENCE, mean_interval

_RESAMPLES = 2000


@dataclass(frozen=True)
class Side:
    """One side of a comparison.

    Attributes:
        results: the run.
        policy: whose lifetimes, as in the column names: ``best``, ``last``, ``oldest_first``, ...
        where: agents to keep, by their values on some axes.
    """

    results: Results
    policy: str = "best"
    where: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """How the side is called in tables."""
        chosen = ", ".join(f"{axis}={value}" for axis, value in self.where.items())
        return f"{self.results.study.name} {self.policy}{f' ({chosen})' if chosen else ''}"

    def lifetimes(self) -> pd.DataFrame:
        """The kept agents, with their lifetime in ``lifetime``.

        Raises:
            StudyError: there is no such policy, or no such agent.
        """
        agents, column = self.results.agents, f"{self.policy.replace('-', '_')}_lifetime"
        if column not in agents:
            known = ", ".join(name.replace("_", "-") for name in self.results.policies)
            raise StudyError(f"{self.results.study.name}: has no policy {self.policy!r}; it has {known}")
        axes = ["seed", *cell_axes(self.results.study)]
        for axis, value in self.where.items():
            if axis not in axes:
                raise StudyError(f"{self.results.study.name}: has no axis {axis!r}; it has {', '.join(axes)}")
            agents = agents[agents[axis] == value]
        if agents.empty:
            raise StudyError(f"{self.name}: no agent is left")
        return agents[[*axes, column]].rename(columns={column: "lifetime"})


def pair(a: Side, b: Side) -> tuple[pd.DataFrame, list[str]]:
    """The agents that both sides have, one row each with ``lifetime_a`` and ``lifetime_b``; and the axes of a cell.

    Raises:
        StudyError: they have none in common, or an agent of one fits several of the other.
    """
    left, right = a.lifetimes(), b.lifetimes()
    pinned = {axis for axis in a.where if axis in b.where}  # each side has one value there, not always the same
    shared = [str(axis) for axis in left if axis in set(right) - {"lifetime"} - pinned]
    for side, table in ((a, left), (b, right)):
        twice = table[table.duplicated(shared)]
        if len(twice):
            others = [str(axis) for axis in table if axis not in (*shared, *pinned, "lifetime")]
            free = [axis for axis in others if table[axis].nunique() > 1]
            raise StudyError(f"{side.name}: several agents fit one of the other run; say which of {', '.join(free)}")
    both = left.merge(right, on=shared, suffixes=("_a", "_b"))
    if both.empty:
        raise StudyError(f"{a.name} and {b.name}: no agents in common on {', '.join(shared)}")
    cells = [axis for axis in shared if axis != "seed"]
    return both[[*shared, "lifetime_a", "lifetime_b"]], cells


def differences(both: pd.DataFrame, cells: list[str]) -> pd.DataFrame:
    """Per cell: seeds, mean lifetime of both, and the paired difference b - a with its 95 % interval over the seeds."""
    rows = []
    for cell, group in both.groupby(cells, sort=False):
        mean, low, high = mean_interval((group["lifetime_b"] - group["lifetime_a"]).to_numpy())
        row = dict(zip(cells, cell, strict=True)) | {"seeds": len(group)}
        row |= {"a": group["lifetime_a"].mean(), "b": group["lifetime_b"].mean()}
        rows.append(row | {"difference": mean, "low": low, "high": high})
    return pd.DataFrame(rows)


def overall(both: pd.DataFrame, cells: list[str]) -> dict[str, tuple[float, float, float]]:
    """Aggregates over all cells with stratified bootstrap intervals: ``(value, low, high)``.

    ``difference``: mean paired difference b - a, slots. ``iqm_a``, ``iqm_b``: interquartile means, slots.
    ``improvement``: probability that b lives longer than a on a random cell, ties counting half.
    """
    groups = [group[["lifetime_a", "lifetime_b"]].to_numpy() for _, group in both.groupby(cells, sort=False)]
    measures: dict[str, Callable[[list[np.ndarray]], float]] = {
        "difference": lambda drawn: float(np.concatenate(drawn).dot([-1.0, 1.0]).mean()),
        "iqm_a": lambda drawn: interquartile_mean(np.concatenate(drawn)[:, 0]),
        "iqm_b": lambda drawn: interquartile_mean(np.concatenate(drawn)[:, 1]),
        "improvement": lambda drawn: float(
            np.mean([probability_of_improvement(one[:, 1], one[:, 0]) for one in drawn])
        ),
    }
    rng, tail = np.random.default_rng(0), 50 * (1 - CONFIDENCE)
    resampled = [[one[rng.integers(len(one), size=len(one))] for one in groups] for _ in range(_RESAMPLES)]
    found = {}
    for name, measure in measures.items():
        low, high = np.percentile([measure(drawn) for drawn in resampled], [tail, 100 - tail])
        alone = min(len(one) for one in groups) < 2
        found[name] = (measure(groups), *((float("nan"),) * 2 if alone else (float(low), float(high))))
    return found


def interquartile_mean(values: np.ndarray) -> float:
    """Mean of the middle half."""
    return float(stats.trim_mean(values, 0.25))


def probability_of_improvement(x: np.ndarray, y: np.ndarray) -> float:
    """Share of the pairs in which ``x`` is above ``y``, ties counting half (Mann-Whitney's U over their number)."""
    ranks = stats.rankdata(np.concatenate([x, y]))[: len(x)]
    return float((ranks.sum() - len(x) * (len(x) + 1) / 2) / (len(x) * len(y)))

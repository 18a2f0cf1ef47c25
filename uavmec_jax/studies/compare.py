"""Compare two runs: paired differences, interquartile means and the probability of improvement.

The last two are those of Agarwal et al. (2021), "Deep reinforcement learning at the edge of the statistical precipice", and
their library rliable, where a cell is a task and a seed is a run.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Num
from scipy import stats

from uavmec_jax.errors import StudyError
from uavmec_jax.studies.measures import MOST_CENSORED
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.statistics import CONFIDENCE, mean_interval

_RESAMPLES = 2000

_Interval = tuple[float, float, float]
"""``(value, low, high)``."""


@dataclass(frozen=True)
class Side:
    """One side of a comparison.

    Attributes:
        results: results of the run.
        policy: name of the policy that is compared: ``best``, ``last``, ``oldest_first``, ...
        where: values on some axes; only agents that have them are compared.
    """

    results: Results
    policy: str = "best"
    where: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the side in tables."""
        values = ", ".join(f"{axis}={value}" for axis, value in self.where.items())
        return f"{self.results.study.name} {self.policy}{f' ({values})' if values else ''}"

    def lifetimes(self) -> pd.DataFrame:
        """Return the agents that are compared: their axes, ``lifetime``, and the share of ``censored`` episodes.

        Raises:
            StudyError: there is no such policy, axis or agent.
        """
        agents, column = self.results.agents, f"{self.policy.replace('-', '_')}_lifetime"
        if agents.empty:
            raise StudyError(
                f"{self.results.study.name}: none of its agents is finished; resume the run, or wait for it"
            )
        if column not in agents:
            policies = ", ".join(name.replace("_", "-") for name in self.results.policies)
            raise StudyError(f"{self.results.study.name}: has no policy {self.policy!r}; it has {policies}")
        axes = ["seed", *cell_axes(self.results.study)]
        for axis, value in self.where.items():
            if axis not in axes:
                raise StudyError(f"{self.results.study.name}: has no axis {axis!r}; it has {', '.join(axes)}")
            if not pd.api.types.is_scalar(value):
                raise StudyError(f"{self.results.study.name}: {axis} is {value!r}; give one value of this axis")
            agents = agents[agents[axis] == value]
        if agents.empty:
            raise StudyError(f"{self.name}: no agent is left")
        censored = agents.get(f"{self.policy.replace('-', '_')}_censored", 0.0)
        return agents[[*axes, column]].rename(columns={column: "lifetime"}).assign(censored=censored)


def pair(a: Side, b: Side) -> tuple[pd.DataFrame, list[str]]:
    """Match the agents of two sides.

    Returns:
        The agents that both sides have, one row each, with ``lifetime_a`` and ``lifetime_b``, and if any episode of them is
        censored, the shares ``censored_a`` and ``censored_b``; and the axes of a cell.

    Raises:
        StudyError: the sides have no agents in common, or an agent of one matches several of the other.
    """
    left, right = a.lifetimes(), b.lifetimes()
    pinned = {axis for axis in a.where if axis in b.where}  # each side has one value there, which may differ
    measures = ("lifetime", "censored")
    shared = [str(axis) for axis in left if axis in set(right) - {*measures} - pinned]
    for side, table in ((a, left), (b, right)):
        if table.duplicated(shared).any():
            others = [str(axis) for axis in table if axis not in (*shared, *pinned, *measures)]
            free = [axis for axis in others if table[axis].nunique() > 1]
            raise StudyError(f"{side.name}: several agents fit one of the other run; say which of {', '.join(free)}")
    both = left.merge(right, on=shared, suffixes=("_a", "_b"))
    if both.empty:
        raise StudyError(f"{a.name} and {b.name}: no agents in common on {', '.join(shared)}")
    cells = [axis for axis in shared if axis != "seed"]
    shares = [name for name in ("censored_a", "censored_b") if both[["censored_a", "censored_b"]].to_numpy().any()]
    return both[[*shared, "lifetime_a", "lifetime_b", *shares]], cells


def mostly_censored(both: pd.DataFrame, cells: list[str]) -> Bool[np.ndarray, " P"]:
    """Return which pairs are in cells in which half or more of the episodes of a side are censored."""
    if "censored_a" not in both:
        return np.zeros(len(both), bool)
    shares = both.groupby(cells, sort=False)[["censored_a", "censored_b"]].transform("mean")
    return np.asarray((shares >= MOST_CENSORED).any(axis=1), bool)


def differences(both: pd.DataFrame, cells: list[str]) -> pd.DataFrame:
    """Return one row per cell: seeds, mean lifetimes, and the paired difference b - a with its 95 % interval over seeds."""
    rows = []
    for cell, group in both.groupby(cells, sort=False):
        mean, low, high = mean_interval((group["lifetime_b"] - group["lifetime_a"]).to_numpy())
        row = dict(zip(cells, cell, strict=True)) | {"seeds": len(group)}
        row |= {"a": group["lifetime_a"].mean(), "b": group["lifetime_b"].mean()}
        row |= {name: group[name].mean() for name in ("censored_a", "censored_b") if name in group}
        rows.append(row | {"difference": mean, "low": low, "high": high})
    return pd.DataFrame(rows)


def overall(both: pd.DataFrame, cells: list[str]) -> dict[str, _Interval]:
    """Aggregate over the cells that are not mostly censored, with 95 % intervals from a bootstrap stratified by cell.

    Returns:
        ``difference``: mean paired difference b - a in slots; ``iqm_a``, ``iqm_b``: interquartile means in slots;
        ``improvement``: probability that the lifetime of b is longer than that of a in a random cell, ties counting half.
        All are NaN if every cell is mostly censored.
    """
    both = both[~mostly_censored(both, cells)]
    groups = [group[["lifetime_a", "lifetime_b"]].to_numpy() for _, group in both.groupby(cells, sort=False)]
    measures: dict[str, Callable[[list[np.ndarray]], float]] = {
        "difference": lambda sample: float(np.concatenate(sample).dot([-1.0, 1.0]).mean()),
        "iqm_a": lambda sample: interquartile_mean(np.concatenate(sample)[:, 0]),
        "iqm_b": lambda sample: interquartile_mean(np.concatenate(sample)[:, 1]),
        "improvement": lambda sample: float(
            np.mean([probability_of_improvement(pairs[:, 1], pairs[:, 0]) for pairs in sample])
        ),
    }
    if not groups:
        return dict.fromkeys(measures, (float("nan"),) * 3)
    rng, tail = np.random.default_rng(0), 50 * (1 - CONFIDENCE)
    samples = [[pairs[rng.integers(len(pairs), size=len(pairs))] for pairs in groups] for _ in range(_RESAMPLES)]
    single_seed = min(len(pairs) for pairs in groups) < 2
    aggregates: dict[str, _Interval] = {}
    for name, measure in measures.items():
        low, high = np.percentile([measure(sample) for sample in samples], [tail, 100 - tail])
        interval = (float("nan"), float("nan")) if single_seed else (float(low), float(high))
        aggregates[name] = (measure(groups), *interval)
    return aggregates


def interquartile_mean(values: Num[np.ndarray, " S"]) -> float:
    """Return the mean of the middle half of the values."""
    return float(stats.trim_mean(values, 0.25))


def probability_of_improvement(x: Num[np.ndarray, " S"], y: Num[np.ndarray, " T"]) -> float:
    """Return the share of pairs in which ``x`` is above ``y``, ties counting half (Mann-Whitney's U per pair)."""
    ranks = stats.rankdata(np.concatenate([x, y]))[: len(x)]
    return float((ranks.sum() - len(x) * (len(x) + 1) / 2) / (len(x) * len(y)))

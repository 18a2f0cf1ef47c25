"""Results of evaluated policies and planners, and their columns in the tidy table."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode

MISSING = -1
"""Lifetime and cause of episodes that were not evaluated; their other numbers are NaN."""


@dataclass(frozen=True)
class EvaluationResult:
    """``E`` episodes of one policy in the scenario of each of ``A`` agents: the held-out draws, and the fixed draw last.

    Attributes:
        lifetime: slots.
        cause: a :class:`Cause`.
        first_failure: share of each device in the first failure of an episode.
        service_s: with ``end = "horizon"``, see :class:`Episode`; else ``None``.
    """

    lifetime: Int[np.ndarray, "A E"]
    cause: Int8[np.ndarray, "A E"]
    first_failure: Float[np.ndarray, "A E n"]
    service_s: Float[np.ndarray, "A E"] | None = None

    @classmethod
    def of(cls, episodes: Episode) -> "EvaluationResult":
        """Return the result of episodes, leaves ``[A, E, ...]``."""
        return cls(
            lifetime=np.asarray(episodes.length),
            cause=np.asarray(episodes.cause, np.int8),
            first_failure=np.asarray(episodes.first_failure),
            service_s=None if episodes.service_s is None else np.asarray(episodes.service_s),
        )

    @property
    def mean_lifetime(self) -> Float[np.ndarray, " A"]:
        """Mean lifetime over the held-out draws."""
        return self.lifetime[:, :-1].mean(axis=1)

    def columns(self, policy: str) -> dict[str, Any]:
        """Return the columns of the tidy table, named after the policy."""
        prefix = policy.replace("-", "_")
        fixed = self.first_failure[:, -1]
        return {
            f"{prefix}_lifetime": self.mean_lifetime,
            f"{prefix}_lifetime_fixed": self.lifetime[:, -1],
            f"{prefix}_cause": [most_common_cause(causes) for causes in self.cause[:, :-1]],
            f"{prefix}_cause_fixed": [Cause(cause).name.lower() for cause in self.cause[:, -1]],
            **first_failure_columns(prefix, self.first_failure[:, :-1].mean(axis=1)),
            f"{prefix}_first_devices_fixed": [" ".join(str(i + 1) for i in np.flatnonzero(row)) for row in fixed],
        }


@dataclass(frozen=True)
class PlannerResult:
    """One planner on the first ``P`` held-out draws of each of ``A`` agents' scenarios.

    Agents for which it was not evaluated have :data:`MISSING` and NaN.

    Attributes:
        lifetime: slots; of ``bound``, an upper bound on the lifetime under any policy.
        cause: a :class:`Cause`; ``None`` for the bound.
        first_failure: share of each device in the first failure of an episode; ``None`` for the bound.
        service_s: with ``end = "horizon"``, see :class:`Episode`; else, and for the bound, ``None``.
    """

    lifetime: Int[np.ndarray, "A P"]
    cause: Int8[np.ndarray, "A P"] | None = None
    first_failure: Float[np.ndarray, "A P n"] | None = None
    service_s: Float[np.ndarray, "A P"] | None = None

    @classmethod
    def of(cls, episodes: Episode, draws: int) -> "PlannerResult":
        """Return the result of episodes, leaves ``[A * P, ...]``, with ``P = draws``."""
        by_agent = lambda leaf: np.asarray(leaf).reshape(-1, draws, *leaf.shape[1:])  # noqa: E731
        return cls(
            lifetime=by_agent(episodes.length),
            cause=by_agent(episodes.cause).astype(np.int8),
            first_failure=by_agent(episodes.first_failure),
            service_s=None if episodes.service_s is None else by_agent(episodes.service_s),
        )

    @classmethod
    def of_none(cls, planner: str, params: Params, draws: int) -> "PlannerResult":
        """Return the result for no agents at all."""
        lifetime = np.zeros((0, draws), np.int32)
        if planner == "bound":
            return cls(lifetime)
        shares = np.zeros((0, draws, params.n_devices), np.float32)
        service_s = np.zeros((0, draws), np.float32) if params.end == "horizon" else None
        return cls(lifetime, np.zeros((0, draws), np.int8), shares, service_s)

    def at(self, rows: Bool[np.ndarray, " A"]) -> "PlannerResult":
        """Return the result for ``A`` agents, of which only those at ``rows`` were evaluated, with this result."""

        def at_rows(array: np.ndarray) -> np.ndarray:
            full = np.full((len(rows), *array.shape[1:]), np.nan if array.dtype.kind == "f" else MISSING, array.dtype)
            full[rows] = array
            return full

        return replace(self, **{name: at_rows(array) for name, array in vars(self).items() if array is not None})

    @property
    def mean_lifetime(self) -> Float[np.ndarray, " A"]:
        """Mean lifetime over the draws, NaN where it was not evaluated."""
        means = self.lifetime.mean(axis=1)
        return np.where((self.lifetime == MISSING).any(axis=1), np.nan, means)

    def columns(self, planner: str) -> dict[str, Any]:
        """Return the columns of the tidy table that say how episodes end; the bound has none."""
        if self.cause is None or self.first_failure is None:
            return {}
        causes = [most_common_cause(causes) for causes in self.cause]
        return {f"{planner}_cause": causes, **first_failure_columns(planner, self.first_failure.mean(axis=1))}


def most_common_cause(causes: Int8[np.ndarray, " D"]) -> str:
    """Return the name of the most common cause; empty if the episodes were not evaluated."""
    return "" if (causes == MISSING).any() else Cause(int(np.bincount(causes).argmax())).name.lower()


def most_common_first_device(share: Float[np.ndarray, " n"]) -> int | float:
    """Return the number (from 1) of the device with the largest share of first failures.

    It is 0 if no device ever fails, and NaN if the shares are not known.
    """
    if np.isnan(share).any():
        return float("nan")
    return int(share.argmax()) + 1 if share.max() > 0 else 0


def first_failure_columns(prefix: str, share: Float[np.ndarray, "A n"]) -> dict[str, Any]:
    """Return the columns of the device that fails first most often, from the devices' shares of first failures."""
    return {
        f"{prefix}_first_device": [most_common_first_device(row) for row in share],
        f"{prefix}_first_share": share.max(axis=1),
    }

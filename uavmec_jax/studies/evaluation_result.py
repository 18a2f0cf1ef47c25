"""Results of evaluated policies and planners, and their columns in the tidy table."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Int8

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.env.rollout import Episode


@dataclass(frozen=True)
class EvaluationResult:
    """``E`` episodes of one policy in the scenario of each of ``A`` agents: the held-out draws, and the fixed draw last.

    Attributes:
        lifetime: slots.
        cause: a :class:`Cause`.
        first_failure: share of each device in the first failure of an episode.
    """

    lifetime: Int[np.ndarray, "A E"]
    cause: Int8[np.ndarray, "A E"]
    first_failure: Float[np.ndarray, "A E n"]

    @classmethod
    def of(cls, episodes: Episode) -> "EvaluationResult":
        """Return the result of episodes, leaves ``[A, E, ...]``."""
        return cls(
            lifetime=np.asarray(episodes.length),
            cause=np.asarray(episodes.cause, np.int8),
            first_failure=np.asarray(episodes.first_failure),
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

    Attributes:
        lifetime: slots; of ``bound``, an upper bound on the lifetime under any policy.
        cause: a :class:`Cause`; ``None`` for the bound.
        first_failure: share of each device in the first failure of an episode; ``None`` for the bound.
    """

    lifetime: Int[np.ndarray, "A P"]
    cause: Int8[np.ndarray, "A P"] | None = None
    first_failure: Float[np.ndarray, "A P n"] | None = None

    @classmethod
    def of(cls, episodes: Episode, shape: tuple[int, int]) -> "PlannerResult":
        """Return the result of episodes, leaves ``[A * P, ...]``, with the axes ``shape = (A, P)``."""
        return cls(
            lifetime=np.asarray(episodes.length).reshape(shape),
            cause=np.asarray(episodes.cause, np.int8).reshape(shape),
            first_failure=np.asarray(episodes.first_failure).reshape(*shape, -1),
        )

    def columns(self, planner: str) -> dict[str, Any]:
        """Return the columns of the tidy table that say how episodes end; the bound has none."""
        if self.cause is None or self.first_failure is None:
            return {}
        causes = [most_common_cause(causes) for causes in self.cause]
        return {f"{planner}_cause": causes, **first_failure_columns(planner, self.first_failure.mean(axis=1))}


def most_common_cause(causes: Int8[np.ndarray, " D"]) -> str:
    """Return the name of the most common cause."""
    return Cause(int(np.bincount(causes).argmax())).name.lower()


def most_common_first_device(share: Float[np.ndarray, " n"]) -> int:
    """Return the number (from 1) of the device with the largest share of first failures; 0 if no device ever fails."""
    return int(share.argmax()) + 1 if share.max() > 0 else 0


def first_failure_columns(prefix: str, share: Float[np.ndarray, "A n"]) -> dict[str, Any]:
    """Return the columns of the device that fails first most often, from the devices' shares of first failures."""
    return {
        f"{prefix}_first_device": [most_common_first_device(row) for row in share],
        f"{prefix}_first_share": share.max(axis=1),
    }

"""Measures of episodes beside the lifetime: how many the time limit cut off, and the service until the horizon.

An episode that reaches ``max_slots`` is censored: its lifetime is only known to be no shorter.
"""

from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Num

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.studies.evaluation_result import MISSING
from uavmec_jax.studies.schema import CLAIRVOYANT, PLANNERS, Study

MOST_CENSORED = 0.5
"""Share of censored episodes from which on a cell is left out of means over cells."""


def with_measures(study: Study, agents: pd.DataFrame, evaluation: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """Return the tidy table with the measures of every policy and planner, as far as the study has them.

    Columns are ``<policy>_service``, the mean time in service as a share of the horizon, if episodes end there; and
    ``<policy>_censored``, the share of censored episodes, if any episode of any policy is censored. Beam and bound, which
    look no further than ``max_slots``, count as censored where they reach it. Policies are measured on the held-out draws,
    planners on theirs; agents for which a planner was not evaluated have NaN.
    """
    names = [name.removesuffix("/lifetime") for name in evaluation if name.endswith("/lifetime")]
    service = {f"{name}_service": _service(study, agents, evaluation, name) for name in names}
    censored = {f"{name}_censored": _censored(study, agents, evaluation, name) for name in names}
    columns = {name: shares for name, shares in service.items() if shares is not None}
    if any(np.nansum(shares) for shares in censored.values()):
        columns |= censored
    return agents.assign(**columns)


def mostly_censored(cells: pd.DataFrame, policies: Iterable[str]) -> Bool[np.ndarray, " C"]:
    """Return which cells to leave out of means over cells: one of the policies has half or more of its episodes censored."""
    columns = [name for policy in policies if (name := f"{policy}_censored") in cells]
    return (cells[columns] >= MOST_CENSORED).any(axis=1).to_numpy(bool)


def _censored(
    study: Study, agents: pd.DataFrame, evaluation: Mapping[str, np.ndarray], name: str
) -> Float[np.ndarray, " A"]:
    """Return each agent's share of censored episodes."""
    lifetime = evaluation[f"{name}/lifetime"]
    if name in CLAIRVOYANT:
        censored = lifetime >= _setting(study, agents, "max_slots")
    else:
        censored = evaluation[f"{name}/cause"] == Cause.NONE
    shares = _held_out(name, censored).mean(axis=1)
    return np.where((lifetime == MISSING).any(axis=1), np.nan, shares)


def _service(
    study: Study, agents: pd.DataFrame, evaluation: Mapping[str, np.ndarray], name: str
) -> Float[np.ndarray, " A"] | None:
    """Return each agent's mean time in service as a share of the horizon; ``None`` if it is not known."""
    if f"{name}/service_s" not in evaluation:
        return None
    shares = evaluation[f"{name}/service_s"] / _setting(study, agents, "horizon_s")
    return np.asarray(_held_out(name, shares).mean(axis=1), float)


def _setting(study: Study, agents: pd.DataFrame, name: str) -> Num[np.ndarray, "A 1"]:
    """Return a scenario parameter of every agent."""
    values = agents[name] if name in agents else np.full(len(agents), getattr(study.params, name))
    return np.asarray(values)[:, None]


def _held_out(name: str, episodes: np.ndarray) -> np.ndarray:
    """Leave out the fixed draw, which comes last and which planners do not have."""
    return episodes if name in PLANNERS else episodes[:, :-1]

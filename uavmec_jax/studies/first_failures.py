"""AgentIds fails first in an evacuation, and whether the reward keeps it from being a device in high traffic (Table 7)."""

from typing import Any

import numpy as np
import pandas as pd

from uavmec_jax.studies.axes import TRAFFIC_WEIGHTS
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.schema import PLANNERS, Study
from uavmec_jax.studies.statistics import mean_interval, sign_test

ALL_PLACES = "all places"
LEARNED = ("best", "last")


def has_places(results: Results) -> bool:
    """Whether a study's towns are places whose evacuation was simulated."""
    return bool(results.run.get("places"))


def with_traffic(table: pd.DataFrame, study: Study) -> pd.DataFrame:
    """Agents or cells of a study with their place and what traffic weighs for them, also where these are no axes."""
    fixed = {name: getattr(study, name) for name in ("place", *TRAFFIC_WEIGHTS) if name not in table}
    return table.assign(**fixed)


def first_failure_counts(results: Results) -> pd.DataFrame:
    """How many of its scenarios each device is the first to fail in: one row per cell, policy and device.

    A scenario (a seed) counts by the share of its held-out episodes in which the device was first; the counts of a row's
    cell add up to its seeds, less the episodes that the UAV's battery ended. Columns: the axes of the cell, ``policy``,
    ``device`` (from 1), ``name``, ``weight``, ``high_traffic``, ``count``, ``seeds``.
    """
    rows = []
    agents = with_traffic(results.agents, results.study)
    axes = [*_other_axes(results.study), "place", *TRAFFIC_WEIGHTS]
    for values, group in agents.groupby(axes, sort=False):
        cell = dict(zip(axes, values, strict=True))
        place = results.run["places"][cell["place"]]
        for policy in players(results):
            counts = results.first_failures(policy)[group.index].sum(axis=0)
            for k, count in enumerate(counts):
                named = {name: place[name][k] for name in ("name", "weight", "high_traffic")}
                rows.append(cell | {"policy": policy, "device": k + 1} | named | {"count": count, "seeds": len(group)})
    return pd.DataFrame(rows)


def first_failure_groups(results: Results) -> dict[str, pd.DataFrame]:
    """The counts cut into parts that differ in what traffic weighs alone, by name: the place, and what else varies."""
    counts = first_failure_counts(results)
    axes = _other_axes(results.study)
    varies = [axis for axis in axes if counts[axis].nunique() > 1]
    groups = {}
    for values, group in counts.groupby([*axes, "place"], sort=False):
        cell = dict(zip([*axes, "place"], values, strict=True))
        groups[", ".join([str(cell["place"]), *(f"{axis} {cell[axis]}" for axis in varies)])] = group
    return groups


def place_frames(results: Results) -> dict[str, pd.DataFrame]:
    """What a study of places has beside its cells: ``first_failures`` and ``claims``; nothing of other studies."""
    if not has_places(results):
        return {}
    return {"first_failures": first_failure_counts(results), "claims": traffic_claims(results)}


def players(results: Results) -> list[str]:
    """Policies and planners whose first failures are known."""
    return [*results.policies, *(name for name in PLANNERS if f"{name}/first_failure" in results.evaluation)]


def high_traffic_share(results: Results, policy: str) -> np.ndarray:
    """``[A]`` share of each agent's episodes in which a device in high traffic is the first to fail."""
    places = with_traffic(results.agents, results.study)["place"]
    busy = np.array([results.run["places"][place]["high_traffic"] for place in places])
    return np.asarray((results.first_failures(policy) * busy).sum(axis=1))


def traffic_claims(results: Results) -> pd.DataFrame:
    """The paper's claim as a test: with traffic in the reward, do fewer first failures hit devices in high traffic?

    Every pair of traffic weights against the same agents without any, seed by seed; per place and policy, and over all
    places (their mean for each seed, since a seed draws the same hardware in each). Columns: ``place``, ``policy``, the
    axes of the cell, ``share`` and ``share_without`` (see :func:`high_traffic_share`), ``difference`` with ``low`` and
    ``high`` (95 %), ``fewer``, ``more``, ``same`` seeds, exact ``p_value``, Cohen's ``g``; ``slots`` of lifetime more,
    ``slots_low``, ``slots_high``. Empty if the study has no agents without traffic in the reward.
    """
    study, rows = results.study, []
    agents, others = with_traffic(results.agents, study), _other_axes(study)
    for policy in (name for name in LEARNED if name in results.policies):
        table = agents.assign(share=high_traffic_share(results, policy), slots=agents[f"{policy}_lifetime"])
        table = table[["seed", *others, "place", *TRAFFIC_WEIGHTS, "share", "slots"]]
        everywhere = (
            table.groupby(["seed", *others, *TRAFFIC_WEIGHTS], sort=False)[["share", "slots"]].mean().reset_index()
        )
        if table["place"].nunique() > 1:
            table = pd.concat([table, everywhere.assign(place=ALL_PLACES)])
        is_paid = (table[list(TRAFFIC_WEIGHTS)] > 0).any(axis=1)
        paid, without = table[is_paid], table[~is_paid].drop(columns=list(TRAFFIC_WEIGHTS))
        pairs = paid.merge(without, on=["seed", *others, "place"], suffixes=("", "_without"))
        for values, group in pairs.groupby([*others, "place", *TRAFFIC_WEIGHTS], sort=False):
            cell = dict(zip([*others, "place", *TRAFFIC_WEIGHTS], values, strict=True))
            rows.append(cell | {"policy": policy} | _claim(group))
    return pd.DataFrame(rows)


def _claim(pairs: pd.DataFrame) -> dict[str, Any]:
    share = (pairs["share"] - pairs["share_without"]).to_numpy()
    slots = (pairs["slots"] - pairs["slots_without"]).to_numpy()
    row: dict[str, Any] = {"share": pairs["share"].mean(), "share_without": pairs["share_without"].mean()}
    row |= dict(zip(("difference", "low", "high"), mean_interval(share), strict=True)) | vars(sign_test(share))
    return row | dict(zip(("slots", "slots_low", "slots_high"), mean_interval(slots), strict=True))


def _other_axes(study: Study) -> list[str]:
    """The axes of a cell that say neither where nor what traffic weighs."""
    return [axis for axis in cell_axes(study) if axis not in ("place", *TRAFFIC_WEIGHTS)]

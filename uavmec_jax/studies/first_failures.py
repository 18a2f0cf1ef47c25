"""First failures in an evacuation, and whether traffic in the reward keeps them off devices in high traffic (Table 7)."""

from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from uavmec_jax.studies.axes import TRAFFIC_WEIGHTS
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.schema import PLANNERS, Study
from uavmec_jax.studies.statistics import mean_interval, sign_test

ALL_PLACES = "all places"
"""Value of ``place`` in rows over all places of a study."""

LEARNED = ("best", "last")
"""Policies that were trained."""


def has_places(results: Results) -> bool:
    """Return whether a study's scenarios are in places whose evacuation was simulated."""
    return bool(results.run.get("places"))


def with_traffic(table: pd.DataFrame, study: Study) -> pd.DataFrame:
    """Return the rows of agents or cells with columns for place and traffic weights, also where these are not axes."""
    constant = {name: getattr(study, name) for name in ("place", *TRAFFIC_WEIGHTS) if name not in table}
    return table.assign(**constant)


def first_failure_counts(results: Results) -> pd.DataFrame:
    """Count the scenarios in which each device is the first to fail: one row per cell, policy and device.

    A scenario (a seed) contributes the share of its held-out episodes in which the device was the first to fail. The counts
    of a cell add up to the seeds for which the policy was evaluated, minus the share of episodes that ended with the UAV's
    battery. Columns: the axes of the cell, ``policy``, ``device`` (from 1), ``name``, ``weight``, ``high_traffic``,
    ``count``, ``seeds``.
    """
    rows = []
    agents = with_traffic(results.agents, results.study)
    axes = [*_other_axes(results.study), "place", *TRAFFIC_WEIGHTS]
    for values, group in agents.groupby(axes, sort=False):
        cell = dict(zip(axes, values, strict=True))
        place = results.run["places"][cell["place"]]
        for policy in policies_and_planners(results):
            shares = results.first_failures(policy)[group.index]
            counts, seeds = np.nansum(shares, axis=0), int(np.isfinite(shares).all(axis=1).sum())
            for i, count in enumerate(counts):
                device = {"device": i + 1} | {name: place[name][i] for name in ("name", "weight", "high_traffic")}
                rows.append(cell | {"policy": policy} | device | {"count": count, "seeds": seeds})
    return pd.DataFrame(rows)


def first_failure_groups(results: Results) -> dict[str, pd.DataFrame]:
    """Split the counts into groups that differ in the traffic weights only, named by place and by what else varies."""
    counts = first_failure_counts(results)
    axes = _other_axes(results.study)
    varying = [axis for axis in axes if counts[axis].nunique() > 1]
    groups = {}
    for values, group in counts.groupby([*axes, "place"], sort=False):
        cell = dict(zip([*axes, "place"], values, strict=True))
        groups[", ".join([str(cell["place"]), *(f"{axis} {cell[axis]}" for axis in varying)])] = group
    return groups


def place_frames(results: Results) -> dict[str, pd.DataFrame]:
    """Return the tables that a study of places has besides its cells: ``first_failures`` and ``claims``; else none."""
    if not has_places(results) or not len(results.agents):
        return {}
    return {"first_failures": first_failure_counts(results), "claims": traffic_claims(results)}


def policies_and_planners(results: Results) -> list[str]:
    """Return the policies and planners whose first failures are known."""
    return [*results.policies, *(name for name in PLANNERS if f"{name}/first_failure" in results.evaluation)]


def high_traffic_share(results: Results, policy: str) -> Float[np.ndarray, " A"]:
    """Return the share of each agent's episodes in which a device in high traffic is the first to fail."""
    places = with_traffic(results.agents, results.study)["place"]
    high_traffic = np.array([results.run["places"][place]["high_traffic"] for place in places])
    return np.asarray((results.first_failures(policy) * high_traffic).sum(axis=1))


def traffic_claims(results: Results) -> pd.DataFrame:
    """Test the paper's claim: with traffic in the reward, fewer first failures hit devices in high traffic.

    Agents of every pair of traffic weights are compared with the same agents without any, seed by seed: per place and
    policy, and over all places (the mean of each seed, which draws the same hardware in all of them).

    Returns:
        Columns ``place``, ``policy`` and the axes of the cell; ``share`` and ``share_without`` (see
        :func:`high_traffic_share`), their ``difference`` with the 95 % interval ``low``, ``high``; the numbers of seeds
        ``fewer``, ``more``, ``same``, exact ``p_value`` and Cohen's ``g`` of the sign test; ``slots``, by which the lifetime
        is longer, with ``slots_low`` and ``slots_high``. Empty if no agents are without traffic in the reward.
    """
    study, rows = results.study, []
    agents, others = with_traffic(results.agents, study), _other_axes(study)
    for policy in (name for name in LEARNED if name in results.policies):
        table = agents.assign(share=high_traffic_share(results, policy), slots=agents[f"{policy}_lifetime"])
        table = table[["seed", *others, "place", *TRAFFIC_WEIGHTS, "share", "slots"]]
        if table["place"].nunique() > 1:
            by_seed = table.groupby(["seed", *others, *TRAFFIC_WEIGHTS], sort=False)
            means = by_seed[["share", "slots"]].mean().reset_index()
            table = pd.concat([table, means.assign(place=ALL_PLACES)])
        weighted = (table[list(TRAFFIC_WEIGHTS)] > 0).any(axis=1)
        without = table[~weighted].drop(columns=list(TRAFFIC_WEIGHTS))
        pairs = table[weighted].merge(without, on=["seed", *others, "place"], suffixes=("", "_without"))
        for values, group in pairs.groupby([*others, "place", *TRAFFIC_WEIGHTS], sort=False):
            cell = dict(zip([*others, "place", *TRAFFIC_WEIGHTS], values, strict=True))
            rows.append(cell | {"policy": policy} | _claim(group))
    return pd.DataFrame(rows)


def _claim(pairs: pd.DataFrame) -> dict[str, Any]:
    """Return the test of one cell from its agents with and without traffic in the reward, one pair per seed."""
    share = (pairs["share"] - pairs["share_without"]).to_numpy()
    slots = (pairs["slots"] - pairs["slots_without"]).to_numpy()
    row: dict[str, Any] = {"share": pairs["share"].mean(), "share_without": pairs["share_without"].mean()}
    row |= dict(zip(("difference", "low", "high"), mean_interval(share), strict=True)) | vars(sign_test(share))
    return row | dict(zip(("slots", "slots_low", "slots_high"), mean_interval(slots), strict=True))


def _other_axes(study: Study) -> list[str]:
    """Return the axes of a cell other than the place and the traffic weights."""
    return [axis for axis in cell_axes(study) if axis not in ("place", *TRAFFIC_WEIGHTS)]

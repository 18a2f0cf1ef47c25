"""What the fleet's energy requires of the hover sets: that their hovering is paid for from batteries and at depots.

Energy is counted in seconds of hovering: a battery is worth as many seconds as the UAV could hover with it, at its least
power. UAVs with different powers then have one unit.
"""

import numpy as np
from jaxtyping import Float, Int

from uavmec_jax.env.fleet import DepotKind, Depots
from uavmec_jax.planning.bound_instance import SLACK, Instance
from uavmec_jax.planning.requirements import Rows


def endurance(instance: Instance, flights: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
    """Return the seconds for which each full battery lets its UAV hover, besides flights in m; the longest first."""
    spent = instance.extra_power * flights / instance.speed
    budget = instance.battery * (1.0 + SLACK) - spent * (1.0 - SLACK)
    power = instance.base_power
    seconds = np.where(power > 0.0, budget / np.where(power > 0.0, power, 1.0), np.where(budget > 0.0, np.inf, -1.0))
    return np.sort(seconds)[::-1]


def add_endurance_rows(rows: Rows, seconds: Float[np.ndarray, " K"], paid: int) -> None:
    """Add the rows of a fleet without depots: ``j`` UAVs hover for no longer than the ``j``-th best battery lasts."""
    slot, size = (index.ravel() for index in np.indices((paid, rows.features.sizes)))
    for least, battery in enumerate(seconds[: rows.features.sizes - 1], 1):
        if 0.0 < battery < np.inf:
            used = size >= least
            rows.add(1.0, (rows.features.seconds(slot[used], size[used]), np.full(used.sum(), 1.0 / battery)))


def add_depot_rows(rows: Rows, instance: Instance, depots: Depots, flights: Float[np.ndarray, " K"]) -> int:
    """Add the rows of a fleet with depots: for all UAVs, and if their batteries differ, for those with the worst ones.

    Args:
        rows: where to.
        instance: the scenario.
        depots: its depots.
        flights: m that each UAV flies at least.

    Returns:
        The number of variables of the rows.
    """
    seconds = endurance(instance, np.zeros(instance.uavs))
    if not np.isfinite(seconds.sum()):
        return 0
    flown = np.sum(instance.extra_power * flights / instance.speed / instance.base_power) * (1.0 - SLACK)
    levels = _add_levels(rows, instance, depots, seconds, float(flown), 0)
    for others in range(1, rows.features.sizes - 1):
        if seconds[others - 1] > seconds[others] * (1.0 + SLACK):
            levels += _add_levels(rows, instance, depots, seconds[others:], 0.0, levels)
    return levels


def _add_levels(
    rows: Rows, instance: Instance, depots: Depots, seconds: Float[np.ndarray, " some"], flown: float, first: int
) -> int:
    """Add the rows for the UAVs with the worst batteries, of which no more than the others hover without them.

    The level of a slot is the energy in their batteries when it begins, as a share of their capacity; before the first slot
    it is 1, before any other a variable.

    Args:
        rows: where to.
        instance: the scenario.
        depots: its depots.
        seconds: :func:`endurance` of their batteries.
        flown: s of hovering that their flights cost in total.
        first: number of the first variable.

    Returns:
        The number of variables.
    """
    total, slots, sizes = seconds.sum(), rows.features.slots, np.arange(rows.features.sizes)
    landed = np.minimum(instance.uavs - sizes, len(seconds))
    refill, charge, packs = _refills(instance, depots, seconds, landed)
    slot, size = np.indices((slots, len(sizes)))
    places, use = rows.features.seconds(slot, size), rows.features.use(slot, size)
    spent, gained = np.maximum(size - (instance.uavs - len(seconds)), 0) / total, -refill[:slots] / total
    for number in range(slots):
        level = {first + number - 1: -1.0} if number else {}
        limit = 0.0 if number else 1.0
        rows.add(limit, (places[number], spent[number]), levels=level)
        if number < slots - 1:
            level = level | {first + number: 1.0}
            rows.add(limit, (places[number], spent[number]), (use[number], gained[number]), levels=level)
    every_slot = places.ravel(), spent.ravel()
    if flown > 0.0:
        rows.add(1.0 - flown / total, every_slot, (use.ravel(), gained.ravel()))
    if np.isfinite(packs):
        charged = -charge[:slots] / total
        rows.add((total + packs * seconds[0] - flown) / total, every_slot, (use.ravel(), charged.ravel()))
    return slots - 1


def _refills(
    instance: Instance, depots: Depots, seconds: Float[np.ndarray, " some"], landed: Int[np.ndarray, " sizes"]
) -> tuple[Float[np.ndarray, "H sizes"], Float[np.ndarray, "H sizes"], float]:
    """Return what depots give at most in each slot in which so many of some UAVs have landed.

    Returns:
        What they give in total; the same without swaps; and the number of swaps for which there are packs.
    """
    swaps = depots.kind == DepotKind.SWAP
    packs = np.where(swaps & (depots.pads >= 1), np.floor(depots.packs), 0.0)
    charges = ~swaps & (depots.power_w > 0)
    power = depots.power_w.max(initial=0.0, where=charges) / instance.base_power.min()
    charge = np.minimum(seconds, power * _longest_slots(instance, depots)[:, None])
    by_swaps, by_charges = (np.pad(np.cumsum(value, axis=-1), ((0, 0), (1, 0))) for value in (seconds[None], charge))
    swapped = np.minimum(landed, np.sum(np.floor(depots.pads[packs >= 1]))).astype(int)
    pads = np.sum(np.floor(depots.pads[charges]))
    others, all_charged = (np.minimum(count, pads).astype(int) for count in (landed - swapped, landed))
    return by_swaps[:, swapped] + by_charges[:, others], by_charges[:, all_charged], float(packs.sum())


def _longest_slots(instance: Instance, depots: Depots) -> Float[np.ndarray, " H"]:
    """Return the length in s that no slot exceeds: no device is served, or one is after the longest flight."""
    points = np.concatenate([instance.position[instance.hover_points], depots.position, instance.start])
    longest = np.linalg.norm(points[:, None] - points[None], axis=-1).max() / instance.speed
    flying = instance.flying_power
    affordable = np.where(flying > 0.0, instance.battery / np.where(flying > 0.0, flying, 1.0), np.inf)
    t_fly = np.minimum(longest, affordable).max()
    covers = instance.covers[instance.hover_points]
    slowest = np.where(covers, instance.rate[instance.hover_points], np.inf).min(axis=0)
    t_upload = (instance.bits / slowest).max(axis=1)
    return np.maximum(instance.t_work.max(axis=1), t_fly + t_upload) * (1.0 + SLACK)

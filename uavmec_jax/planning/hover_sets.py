"""The hover sets of a fleet: where its UAVs hover in a slot, which devices they serve, and how long the slot is at least.

A *hover set* is a set of at most K hover points, with a UAV above each. UAVs that share a hover point count once, those that
have landed or are grounded not at all; the empty set occurs only if there are depots. If the signal ranges differ, the
largest is used for all, and the bound counts a device in range as served or not served, whichever helps the network.
"""

from abc import ABC, abstractmethod
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

MAX_LISTED = 20_000
"""Hover sets up to which they are listed."""


class Columns(NamedTuple):
    """``W`` ways to spend a slot.

    Attributes:
        slot: the slot.
        size: size of the hover set.
        duration: s, least length of the slot.
        served: how often each device is served.
    """

    slot: Int[np.ndarray, " W"]
    size: Int[np.ndarray, " W"]
    duration: Float[np.ndarray, " W"]
    served: Float[np.ndarray, "W n"]


class Prices(NamedTuple):
    """What a hover set costs in each of ``T`` slots: ``by_second * duration + by_use - by_service @ served``.

    Attributes:
        by_second: by size of the hover set.
        by_use: by size of the hover set.
        by_service: of each device.
    """

    by_second: Float[np.ndarray, "T sizes"]
    by_use: Float[np.ndarray, "T sizes"]
    by_service: Float[np.ndarray, "T n"]


class HoverSets(ABC):
    """The hover sets of a fleet, listed or not.

    Attributes:
        shortest: s, least length of each of ``H`` slots.
        sizes: number of sizes, from 0 to the largest one.
    """

    shortest: Float[np.ndarray, " H"]
    sizes: int

    @abstractmethod
    def cheapest(self, prices: Prices, largest: Int[np.ndarray, " T"]) -> tuple[Float[np.ndarray, " T"], Columns]:
        """Return what the cheapest set costs in each of ``T`` slots, and these sets; none is larger than ``largest``."""


class ListedHoverSets(HoverSets):
    """All ``C`` sets of up to ``uavs`` of ``q`` hover points.

    Args:
        uavs: number of UAVs K.
        covers: which devices each hover point covers.
        rate: bit/s, of each device's upload to each hover point.
        t_work: s, time that a device works in each of ``H`` slots if it is not served.
        bits: size of each device's task.
        may_be_empty: whether a slot may start without a UAV that hovers.
        may_decline: whether a device in range counts as served or not served, whichever helps the network.
    """

    def __init__(
        self,
        uavs: int,
        covers: Bool[np.ndarray, "q n"],
        rate: Float[np.ndarray, "q n"],
        t_work: Float[np.ndarray, "H n"],
        bits: Float[np.ndarray, "H n"],
        *,
        may_be_empty: bool,
        may_decline: bool,
    ) -> None:
        self.sizes = min(uavs, len(covers)) + 1
        members = [
            np.array(list(combinations(range(len(covers)), size)), int)
            for size in range(0 if may_be_empty else 1, self.sizes)
        ]
        self._size = np.concatenate([np.full(len(sets), sets.shape[1]) for sets in members])
        reached = np.where(covers, rate, 0.0)
        best = np.concatenate([reached[sets].max(axis=1, initial=0.0) for sets in members])
        self._served = (best > 0.0).astype(float)
        self._duration = np.zeros((len(t_work), len(best)))
        for device in range(t_work.shape[1]):
            served, busy = best[:, device] > 0.0, np.repeat(t_work[:, device, None], len(best), axis=1)
            t_upload = bits[:, device, None] / best[served, device]
            busy[:, served] = np.minimum(busy[:, served], t_upload) if may_decline else t_upload
            np.maximum(self._duration, busy, out=self._duration)
        self.shortest = self._duration.min(axis=1)

    def cheapest(self, prices: Prices, largest: Int[np.ndarray, " T"]) -> tuple[Float[np.ndarray, " T"], Columns]:
        """See :class:`HoverSets`."""
        slots = np.arange(len(largest))
        cost = prices.by_second[:, self._size] * self._duration[: len(largest)] + prices.by_use[:, self._size]
        cost -= prices.by_service @ self._served.T
        cost[self._size > largest[:, None]] = np.inf
        best = cost.argmin(axis=1)
        return cost[slots, best], Columns(slots, self._size[best], self._duration[slots, best], self._served[best])


class LooseHoverSets(HoverSets):
    """A superset of the hover sets that need not be listed.

    The UAVs are chosen one by one: services of different UAVs count separately even if they are to the same device, and the
    slot is as short as any hover set of that size can make it. Prices of services must not be negative.

    Args:
        covers: which devices each of ``q`` hover points covers.
        duration: s, least length of each of ``H`` slots with a hover set of each size.
        may_be_empty: whether a slot may start without a UAV that hovers.
    """

    def __init__(
        self, covers: Bool[np.ndarray, "q n"], duration: Float[np.ndarray, "H sizes"], *, may_be_empty: bool
    ) -> None:
        self.sizes = duration.shape[1]
        self.shortest = duration.min(axis=1)
        self._covers, self._duration, self._may_be_empty = covers, duration, may_be_empty

    def cheapest(self, prices: Prices, largest: Int[np.ndarray, " T"]) -> tuple[Float[np.ndarray, " T"], Columns]:
        """See :class:`HoverSets`."""
        slots, sizes = np.arange(len(largest)), np.arange(self.sizes)
        gain = prices.by_service @ self._covers.T
        order = np.argsort(-gain, axis=1)[:, : self.sizes - 1]
        gains = np.cumsum(np.take_along_axis(gain, order, axis=1), axis=1)
        cost = prices.by_second * self._duration[: len(largest)] + prices.by_use
        cost[:, 1:] -= gains
        cost[sizes > largest[:, None]] = np.inf
        if not self._may_be_empty:
            cost[:, 0] = np.inf
        size = cost.argmin(axis=1)
        chosen = np.arange(self.sizes - 1) < size[:, None]
        served = np.sum(self._covers[order] & chosen[..., None], axis=1).astype(float)
        return cost[slots, size], Columns(slots, size, self._duration[slots, size], served)


def number_of_sets(uavs: int, points: int) -> int:
    """Return the number of sets of 1 to ``uavs`` hover points."""
    return sum(comb(points, size) for size in range(1, uavs + 1))

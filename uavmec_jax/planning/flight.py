"""A lower bound on the distance that a UAV must fly to keep data fresh.

Let E be the number of slots after which the data of an unserved device expire. While no data expire, any E consecutive
slots contain a visit to each device without communication. Call a sequence of flights that visits all of them a *round*.
The first round is therefore complete by slot E at the latest. It ends with the first visit to some device, and the E slots
that begin with this visit again contain a visit to each device; hence every E - 1 further slots hold one more round, which
starts where the previous one ended.

A round is at least as long as the shortest path through hover points that cover all these devices. This is a generalised
travelling-salesman path; it is computed exactly by the dynamic programme of Bellman (1962) and of Held and Karp (1962). The
bound chains shortest rounds over their end points.
"""

from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

MAX_ROUND_DEVICES = 10
"""Devices up to which rounds are computed exactly, over ``2**MAX_ROUND_DEVICES`` subsets."""


class Rounds:
    """Shortest rounds of one layout through its devices without communication.

    Args:
        position: ``[n, 2]`` m.
        covers: ``[n, n]`` bool, ``covers[a, d]``: a UAV hovering above ``a`` serves ``d``.
        disconnected: ``[n]`` bool, the devices without communication. Only the first :data:`MAX_ROUND_DEVICES` of them
            are considered; a round through fewer devices is no longer, so the bound remains valid.
        slots_to_expiry: slots without service after which data have expired (E above).
        start: m, where the UAV starts; by default at the origin.
        may_land: whether the UAV may also land at a depot, and then need not fly to a device if none falls due. (Flights to
            depots between those to devices do not shorten a round.)
    """

    def __init__(
        self,
        position: Float[np.ndarray, "n 2"],
        covers: Bool[np.ndarray, "n n"],
        disconnected: Bool[np.ndarray, " n"],
        slots_to_expiry: int,
        start: Float[np.ndarray, " 2"] | None = None,
        *,
        may_land: bool = False,
    ) -> None:
        from_start = np.linalg.norm(position if start is None else position - start, axis=-1)
        devices = np.flatnonzero(disconnected)[:MAX_ROUND_DEVICES]
        subsets = covers[:, devices].astype(int) @ (1 << np.arange(len(devices)))
        hover = np.flatnonzero(subsets)
        # Sets of devices are bit masks: the devices served from each of the q useful hover points, and all devices.
        self._served, self._all = subsets[hover], (1 << len(devices)) - 1
        self._from_start = from_start[hover]
        self._distance = np.linalg.norm(position[hover, None] - position[None, hover], axis=-1)
        self._nearest = 0.0 if may_land else float(from_start.min())
        self._slots_to_expiry = slots_to_expiry

    def min_distance(self, slots: int) -> float:
        """Return the least distance in m that the UAV flies if no data expire for ``slots`` slots and one more starts."""
        if not self._all or slots < self._slots_to_expiry:
            return self._nearest
        distance = self._first
        for _ in range((slots - self._slots_to_expiry) // max(self._slots_to_expiry - 1, 1)):
            distance = np.min(distance[:, None] + self._next, axis=0)
        return float(distance.min())

    @cached_property
    def _first(self) -> Float[np.ndarray, " q"]:
        """Length in m of the shortest first round that ends at each hover point."""
        return self._shortest_paths(self._from_start[None])[0]

    @cached_property
    def _next(self) -> Float[np.ndarray, "q q"]:
        """Length in m of the shortest later round from one hover point to another."""
        start = np.full((len(self._served),) * 2, np.inf)
        np.fill_diagonal(start, 0.0)
        return self._shortest_paths(start)

    def _shortest_paths(self, start: Float[np.ndarray, "B q"]) -> Float[np.ndarray, "B q"]:
        """Return the lengths in m of the shortest paths that serve all devices and end at each hover point.

        Args:
            start: m, distance at which each path reaches each hover point if that is its first.
        """
        length = np.full((len(start), self._all + 1, len(self._served)), np.inf)
        for hover, served in enumerate(self._served):
            length[:, served, hover] = np.minimum(length[:, served, hover], start[:, hover])
        for done in range(1, self._all):
            onward = np.min(length[:, done, :, None] + self._distance, axis=1)
            for hover, served in enumerate(self._served):
                if (union := done | served) != done:
                    length[:, union, hover] = np.minimum(length[:, union, hover], onward[:, hover])
        return length[:, self._all]

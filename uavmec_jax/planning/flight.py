"""The least that a UAV must fly to keep data fresh: shortest rounds through the devices without communication.

Data expire after E slots without service, so any E slots in a row contain a visit to each of these devices. The first
round (a visit to each) is thus complete by slot E at the latest. It ends at some device at the slot of that device's
visit, and the E slots from there on contain a visit to each again: every E - 1 further slots hold one more round, which
starts where the last one ended. A round is at least as long as the shortest path through hover points that serve all
these devices (a generalised travelling-salesman path, exact by the dynamic programme of Bellman 1962 and of Held and
Karp 1962), and rounds are chained over their end points.
"""

from functools import cached_property

import numpy as np

MOST_DEVICES = 10
"""Rounds are computed exactly for at most this many devices (``2**MOST_DEVICES`` subsets)."""


class Rounds:
    """Shortest rounds of one layout.

    Args:
        position: ``[n, 2]`` m; the UAV starts at the origin.
        covers: ``[n, n]`` bool, ``covers[a, d]``: hovering above a serves d.
        calls: ``[n]`` bool, devices whose data expire. Of more than :data:`MOST_DEVICES` the first ones are considered;
            a round through fewer devices is no longer, so the bound holds.
        to_expiry: slots E without service after which data have expired.
    """

    def __init__(self, position: np.ndarray, covers: np.ndarray, calls: np.ndarray, to_expiry: int) -> None:
        called = np.flatnonzero(calls)[:MOST_DEVICES]
        serves = covers[:, called].astype(int) @ (1 << np.arange(len(called)))
        hover = np.flatnonzero(serves)
        self._serves, self._everyone = serves[hover], (1 << len(called)) - 1
        self._from_start = np.linalg.norm(position[hover], axis=-1)
        self._apart = np.linalg.norm(position[hover, None] - position[None, hover], axis=-1)
        self._nearest = float(np.linalg.norm(position, axis=-1).min())
        self._to_expiry = to_expiry

    def least_flight(self, slots: int) -> float:
        """Metres that the UAV flies at least while no data expire for ``slots`` slots (one slot more is started)."""
        if not self._everyone or slots < self._to_expiry:
            return self._nearest
        flown = self._first
        for _ in range((slots - self._to_expiry) // max(self._to_expiry - 1, 1)):
            flown = np.min(flown[:, None] + self._further, axis=0)
        return float(flown.min())

    @cached_property
    def _first(self) -> np.ndarray:
        """``[q]`` m, shortest first round that ends above each hover point."""
        return self._paths(self._from_start[None])[0]

    @cached_property
    def _further(self) -> np.ndarray:
        """``[q, q]`` m, shortest round that starts above one hover point and ends above another."""
        start = np.full((len(self._serves),) * 2, np.inf)
        np.fill_diagonal(start, 0.0)
        return self._paths(start)

    def _paths(self, start: np.ndarray) -> np.ndarray:
        """``[B, q]`` m, shortest paths that serve everyone, from ``start [B, q]`` (metres to the first hover point)."""
        flown = np.full((len(start), self._everyone + 1, len(self._serves)), np.inf)
        for hover, serves in enumerate(self._serves):
            flown[:, serves, hover] = np.minimum(flown[:, serves, hover], start[:, hover])
        for done in range(1, self._everyone):
            onward = np.min(flown[:, done, :, None] + self._apart, axis=1)
            for hover, serves in enumerate(self._serves):
                if (more := done | serves) != done:
                    flown[:, more, hover] = np.minimum(flown[:, more, hover], onward[:, hover])
        return flown[:, self._everyone]

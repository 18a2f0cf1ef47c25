"""Requirements: linear inequalities over the features of the hover sets in all slots."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from uavmec_jax.planning.hover_sets import Columns, Prices


class Features(NamedTuple):
    """The features of the hover sets in ``slots`` slots, over which requirements are linear, as places in one vector."""

    slots: int
    devices: int
    sizes: int

    @property
    def length(self) -> int:
        """Length of the vector."""
        return self.slots * (self.devices + 2 * self.sizes)

    def service(self, slot: Int[np.ndarray, "*N"], device: Int[np.ndarray, "*N"]) -> Int[np.ndarray, "*N"]:
        """Return the place of: how often a device is served in a slot."""
        return slot * self.devices + device

    def seconds(self, slot: Int[np.ndarray, "*N"], size: Int[np.ndarray, "*N"]) -> Int[np.ndarray, "*N"]:
        """Return the place of: the length of a slot, if the hover set has this size; else 0."""
        return self.slots * self.devices + slot * self.sizes + size

    def use(self, slot: Int[np.ndarray, "*N"], size: Int[np.ndarray, "*N"]) -> Int[np.ndarray, "*N"]:
        """Return the place of: whether the hover set has this size."""
        return self.slots * (self.devices + self.sizes) + slot * self.sizes + size

    def of(self, columns: Columns) -> csr_array:
        """Return the features ``[length, W]`` of columns."""
        column = np.arange(len(columns.slot))
        served, device = np.nonzero(columns.served)
        places = (
            self.service(columns.slot[served], device),
            self.seconds(columns.slot, columns.size),
            self.use(columns.slot, columns.size),
        )
        values = np.concatenate([columns.served[served, device], columns.duration, np.ones(len(column))])
        index = np.concatenate(places), np.concatenate([served, column, column])
        return csr_array((values, index), shape=(self.length, len(column)))

    def prices(self, costs: Float[np.ndarray, " length"]) -> Prices:
        """Return the costs of features, by kind."""
        services, seconds, use = np.split(costs, [self.slots * self.devices, self.slots * (self.devices + self.sizes)])
        return Prices(
            by_second=seconds.reshape(self.slots, self.sizes),
            by_use=use.reshape(self.slots, self.sizes),
            by_service=-services.reshape(self.slots, self.devices),
        )


class Requirements(NamedTuple):
    """Inequalities ``rows @ features + levels @ z <= limits``, for some ``z`` in ``[0, 1]``.

    Attributes:
        features: what the rows are about.
        rows: sparse ``[R, features.length]``.
        levels: sparse ``[R, L]``.
        limits: ``[R]``.
        largest: largest size of a hover set in each slot.
    """

    features: Features
    rows: csr_array
    levels: csr_array
    limits: Float[np.ndarray, " R"]
    largest: Int[np.ndarray, " T"]


_Term = tuple[Int[np.ndarray, " _"], Float[np.ndarray, " _"]]
"""Places of features and their coefficients."""

_Entries = tuple[Int[np.ndarray, " _"], Int[np.ndarray, " _"], Float[np.ndarray, " _"]]
"""Rows, columns and values of entries of a sparse matrix."""


class Rows:
    """Requirements under construction.

    Args:
        features: what the rows are about.
    """

    def __init__(self, features: Features) -> None:
        self.features = features
        self._limits: list[float] = []
        self._entries: list[_Entries] = []
        self._levels: list[_Entries] = []

    def add(self, limit: float, *terms: _Term, levels: dict[int, float] | None = None) -> None:
        """Add the row ``sum(terms) + sum(levels) <= limit``.

        Args:
            limit: the right-hand side.
            terms: places of features and their coefficients.
            levels: coefficients of the variables in ``[0, 1]``, by number.
        """
        row = len(self._limits)
        self._limits.append(limit)
        self._entries += [(np.full(len(places), row), places, values) for places, values in terms]
        if levels:
            numbers, values = np.array(list(levels)), np.array(list(levels.values()))
            self._levels.append((np.full(len(levels), row), numbers, values))

    def build(self, largest: Int[np.ndarray, " T"], levels: int = 0) -> Requirements:
        """Return the requirements.

        Args:
            largest: largest size of a hover set in each slot.
            levels: number of variables in ``[0, 1]``.
        """
        count = len(self._limits)
        return Requirements(
            features=self.features,
            rows=_sparse(self._entries, (count, self.features.length)),
            levels=_sparse(self._levels, (count, levels)),
            limits=np.array(self._limits),
            largest=largest,
        )


def _sparse(entries: list[_Entries], shape: tuple[int, int]) -> csr_array:
    none = np.zeros(0, int)
    row, column, value = (np.concatenate(parts) for parts in zip((none, none, np.zeros(0)), *entries, strict=True))
    return csr_array((value, (row, column)), shape=shape)

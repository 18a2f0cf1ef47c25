"""A certificate: the lifetime that no policy passes on one layout with one volume draw.

A life of k slots asks for k - 1 slots that every device survives and for k slots that the UAV pays for. Both are written
as a linear program over ``x[t, a]``, the share of slot t that the UAV spends above device a, with everything relaxed that
is not linear: ``rows @ x <= limits`` and ``sum_a x[t, a] = 1``. HiGHS (Huangfu and Hall 2018, through SciPy) looks for the
``x`` that violates the rows least. Its multipliers ``y >= 0`` are the certificate: if ``sum_t min_a (y @ rows)[t, a]``
exceeds ``y @ limits``, then no ``x`` at all satisfies the rows, and no policy lives k slots. That inequality is checked
here, so the bound does not hang on the solver's tolerances. (Whole visits, the mixed-integer program, were measured to
gain nothing over the whole-visit rows below.)

What is relaxed: flight time does not lengthen a slot; uploads are those from right above a device; the UAV's flights
cost at least what :mod:`uavmec_jax.planning.flight` says the rounds through the devices without communication take.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Num
from scipy.optimize import linprog

from uavmec_jax.env.dynamics import slots_to_expiry
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning import demand
from uavmec_jax.planning.beam import counting_bound
from uavmec_jax.planning.flight import Rounds

_SLACK = 1e-5
"""Relative allowance for the single precision of the slot's physics; in favour of the network."""

_ROUNDING = 1e-10
"""Relative allowance for the double precision of the check."""

_SOLVED = 0
"""Status of SciPy's ``linprog``."""


@dataclass(frozen=True)
class _Facts:
    """A scenario with a volume draw, NumPy in double precision; see :class:`demand.SlotCosts` and :class:`Layout`."""

    position: np.ndarray
    capacity: np.ndarray
    standby_power: np.ndarray
    has_power: np.ndarray
    has_comms: np.ndarray
    covers: np.ndarray
    duration: np.ndarray
    work: np.ndarray
    upload: np.ndarray
    counting: int
    base_power: float
    extra_power: float
    to_expiry: int
    unfinished: int
    uav_battery: float
    uav_speed: float


@jax.jit
@jax.vmap
def _facts(params: Params, layout: Layout, volumes: Num[Array, "H n"]) -> dict[str, Any]:
    costs = demand.slot_costs(params, layout, volumes)
    base, extra = demand.flight_power(params)
    taken = ("position", "capacity", "standby_power", "has_power", "has_comms")
    return {name: getattr(layout, name) for name in taken} | {
        "covers": demand.coverage(params, layout),
        "duration": costs.duration,
        "work": costs.work,
        "upload": costs.upload,
        "counting": counting_bound(params, layout, costs),
        "base_power": base,
        "extra_power": extra,
        "to_expiry": slots_to_expiry(params),
        "unfinished": jnp.where(params.count_unfinished_slot, 1, 0),
        "uav_battery": params.uav_battery_j,
        "uav_speed": params.uav_speed_m_s,
    }


def upper_bound(params: Params, layout: Layout, volumes: Num[Array, "H n"], at_least: int = 1) -> int:
    """The longest lifetime, in slots, that is not refuted; every policy's lifetime is at most this.

    Args:
        params: scenario parameters.
        layout: the devices.
        volumes: bytes, ``H`` from :func:`uavmec_jax.planning.beam.horizon`.
        at_least: a lifetime that some policy reached; the search starts there and is short if that is the optimum.

    Raises:
        ValueError: the volumes end before a life may.
    """
    params, layout, volumes = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (params, layout, volumes))
    return int(upper_bounds(params, layout, volumes, np.array([at_least]))[0])


def upper_bounds(
    params: Params, layouts: Layout, volumes: Num[Array, "B H n"], at_least: np.ndarray
) -> Int[np.ndarray, " B"]:
    """:func:`upper_bound` for ``B`` scenarios; every leaf has a leading ``B``."""
    found = {name: np.asarray(leaf) for name, leaf in _facts(params, layouts, volumes).items()}
    slots = volumes.shape[1]
    if np.any((found["counting"] >= slots) & (slots < np.asarray(params.max_slots))):
        raise ValueError(f"volumes are given for {slots} slots, and lives may be longer; give more")
    found = {name: leaf.astype(float) if leaf.dtype == np.float32 else leaf for name, leaf in found.items()}
    facts = (
        _Facts(**{name: leaf[b] if leaf.ndim > 1 else leaf[b].item() for name, leaf in found.items()})
        for b in range(len(at_least))
    )
    return np.array([_bound(own, int(reached)) for own, reached in zip(facts, at_least, strict=True)], np.int32)


def _bound(facts: _Facts, low: int) -> int:
    """The longest life from ``low`` on that is not refuted. A refuted life refutes every longer one."""
    rounds = Rounds(facts.position, facts.covers, ~facts.has_comms, facts.to_expiry)
    high = facts.counting
    if low < high and not _possible(facts, rounds, low + 1):
        return low
    low = min(low + 1, high) if low < high else low
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if _possible(facts, rounds, middle) else (low, middle - 1)
    return low


def _possible(facts: _Facts, rounds: Rounds, life: int) -> bool:
    """Whether the relaxation leaves a lifetime of ``life`` slots open."""
    survive, paid = life - 1, life - facts.unfinished
    slots = max(survive, paid, 1)
    rows, limits = _battery_rows(facts, survive, slots)
    if rows is None:
        return False
    fresh = _age_rows(facts, survive, slots)
    energy = np.zeros((1, *rows.shape[1:]))
    energy[0, :paid] = facts.base_power * facts.duration[:paid]
    flights = facts.extra_power * rounds.least_flight(survive) / facts.uav_speed
    budget = facts.uav_battery * (1.0 + _SLACK) - flights * (1.0 - _SLACK)
    if budget <= 0.0:
        return False
    rows = np.concatenate([rows, fresh, energy / budget])
    return not _refuted(rows, np.concatenate([limits, np.full(len(fresh), -1.0), [1.0]]))


def _refuted(rows: np.ndarray, limits: np.ndarray) -> bool:
    """Whether no ``x [T, n]`` with ``x >= 0`` and ``x[t].sum() = 1`` has ``rows [R, T, n] @ x <= limits [R]``."""
    count, slots, n = rows.shape
    flat = rows.reshape(count, slots * n)
    answer = linprog(
        np.append(np.zeros(slots * n), 1.0),
        A_ub=np.column_stack([flat, np.full(count, -1.0)]),
        b_ub=limits,
        A_eq=np.column_stack([np.kron(np.eye(slots), np.ones(n)), np.zeros(slots)]),
        b_eq=np.ones(slots),
        bounds=[*[(0.0, None)] * (slots * n), (None, None)],
        method="highs-ds",
    )
    if answer.status != _SOLVED:
        return False
    multipliers = np.maximum(-answer.ineqlin.marginals, 0.0)
    least = np.sum(np.min((multipliers @ flat).reshape(slots, n), axis=1))
    return bool(least > multipliers @ limits + _ROUNDING * np.abs(multipliers) @ np.abs(limits))


def _battery_rows(facts: _Facts, survive: int, slots: int) -> tuple[np.ndarray | None, np.ndarray]:
    """``rows @ x <= limits`` for the batteries: energy, and whole visits with the largest savings skipped first.

    ``None`` if a battery is empty even with a service in every slot.
    """
    n = len(facts.capacity)
    rows, limits = [], []
    shortest = facts.duration[:survive].min(axis=1, initial=np.inf)
    for device in np.flatnonzero(~facts.has_power):
        served = facts.covers[:, device]
        capacity, standby = facts.capacity[device] * (1.0 + _SLACK), facts.standby_power[device]
        work, upload = facts.work[:survive, device], facts.upload[:survive, device]
        row = np.zeros((slots, n))
        row[:survive] = standby * facts.duration[:survive] + np.where(served, upload[:, None], work[:, None])
        rows.append(row / capacity)
        limits.append(1.0)
        saved = np.cumsum(np.sort(np.maximum(work - upload, 0.0))[::-1])
        missing = np.sum(standby * shortest + work) - capacity
        visits = 0 if missing < 0 else 1 + int(np.sum(saved <= missing))
        if visits > survive:
            return None, np.zeros(0)
        if visits:
            row = np.zeros((slots, n))
            row[:survive] = -served.astype(float)
            rows.append(row)
            limits.append(-float(visits))
    return np.array(rows).reshape(-1, slots, n), np.array(limits)


def _age_rows(facts: _Facts, survive: int, slots: int) -> np.ndarray:
    """``rows @ x <= -1``: a device without communication is served in every run of slots that expires its data."""
    rows = []
    for device in np.flatnonzero(~facts.has_comms):
        for start in range(survive - facts.to_expiry + 1):
            row = np.zeros((slots, len(facts.capacity)))
            row[start : start + facts.to_expiry] = -facts.covers[:, device].astype(float)
            rows.append(row)
    return np.array(rows).reshape(-1, slots, len(facts.capacity))

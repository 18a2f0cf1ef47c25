"""A certified upper bound: the lifetime that no policy exceeds on one layout with one volume draw.

A lifetime of k slots requires that every device survives k - 1 slots and that the UAV's energy pays for k slots. Both
requirements are relaxed to a linear program over ``x[t, a]``, the share of slot t that the UAV spends above device a::

    rows @ x <= limits,    sum_a x[t, a] = 1,    x >= 0.

HiGHS (Huangfu and Hall 2018, through SciPy) minimises the largest violation of the rows. The certificate is its vector of
dual multipliers ``y >= 0``: if ``sum_t min_a (y @ rows)[t, a] > y @ limits``, then no ``x`` whatsoever satisfies the rows,
and no policy lives for k slots. This inequality (a Farkas certificate) is checked here, so the bound does not depend on the
tolerances of the solver. If k slots are refuted, so is every longer lifetime, and the bound is found by bisection.

The relaxation drops what is not linear: flight time does not lengthen a slot, uploads cost what they cost from right above
the device, and the UAV's flights cost at least what :mod:`uavmec_jax.planning.flight` derives for the rounds through the
devices without communication. Integrality is kept in the rows that count whole visits; measured on top of them, the
mixed-integer program gained nothing.
"""

from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num
from scipy.optimize import linprog

from uavmec_jax.env.dynamics import slots_to_expiry
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning import demand
from uavmec_jax.planning.beam_score import counting_bound
from uavmec_jax.planning.flight import Rounds

_SLACK = 1e-5
"""Relative tolerance for the single precision of the slot's physics, in favour of the network."""

_ROUNDING = 1e-10
"""Relative tolerance for the double precision of the certificate's check."""

_SOLVED = 0
"""Status of SciPy's ``linprog`` for an optimal solution."""


@dataclass(frozen=True)
class _Instance:
    """One scenario with one volume draw, in double precision; see :class:`demand.SlotCosts` and :class:`Layout`."""

    position: Float[np.ndarray, "n 2"]
    capacity: Float[np.ndarray, " n"]
    standby_power: Float[np.ndarray, " n"]
    has_power: Bool[np.ndarray, " n"]
    has_comms: Bool[np.ndarray, " n"]
    covers: Bool[np.ndarray, "n n"]
    duration: Float[np.ndarray, "H n"]
    work: Float[np.ndarray, "H n"]
    upload: Float[np.ndarray, "H n"]
    counting_bound: int
    base_power: float
    extra_power: float
    slots_to_expiry: int
    unfinished: int
    uav_battery: float
    uav_speed: float


@jax.jit
@jax.vmap
def _quantities(params: Params, layout: Layout, volumes: Num[Array, "H n"]) -> dict[str, Array]:
    """Compute the fields of :class:`_Instance` for ``B`` scenarios; leaves ``[B, ...]``."""
    costs = demand.slot_costs(params, layout, volumes)
    base, extra = demand.flight_power(params)
    from_layout = ("position", "capacity", "standby_power", "has_power", "has_comms")
    return {name: getattr(layout, name) for name in from_layout} | {
        "covers": demand.coverage(params, layout),
        "duration": costs.duration,
        "work": costs.work,
        "upload": costs.upload,
        "counting_bound": counting_bound(params, layout, costs),
        "base_power": base,
        "extra_power": extra,
        "slots_to_expiry": slots_to_expiry(params),
        "unfinished": jnp.where(params.count_unfinished_slot, 1, 0),
        "uav_battery": params.uav_battery_j,
        "uav_speed": params.uav_speed_m_s,
    }


def upper_bound(params: Params, layout: Layout, volumes: Num[Array, "H n"], reached: int = 1) -> int:
    """Return the longest lifetime in slots that cannot be refuted; no policy exceeds it.

    Args:
        params: scenario parameters.
        layout: the devices.
        volumes: bytes, ``H`` from :func:`uavmec_jax.planning.beam.horizon`.
        reached: a lifetime that some policy reaches; the search starts there and is short if it is optimal.

    Raises:
        ValueError: the volumes end before a lifetime may.
    """
    params, layout, volumes = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (params, layout, volumes))
    return int(upper_bounds(params, layout, volumes, np.array([reached]))[0])


def upper_bounds(
    params: Params, layouts: Layout, volumes: Num[Array, "B H n"], reached: Num[np.ndarray, " B"]
) -> Int[np.ndarray, " B"]:
    """Return the :func:`upper_bound` of each of ``B`` scenarios; every leaf has a leading ``B``."""
    chex.assert_shape(volumes, (len(reached), None, layouts.capacity.shape[1]))
    batch = {name: np.asarray(leaf) for name, leaf in _quantities(params, layouts, volumes).items()}
    slots = volumes.shape[1]
    if np.any((batch["counting_bound"] >= slots) & (slots < np.asarray(params.max_slots))):
        raise ValueError(f"volumes are given for {slots} slots, and lifetimes may be longer; give more")
    batch = {name: leaf.astype(float) if leaf.dtype == np.float32 else leaf for name, leaf in batch.items()}
    instances = (
        _Instance(**{name: leaf[b] if leaf.ndim > 1 else leaf[b].item() for name, leaf in batch.items()})
        for b in range(len(reached))
    )
    bounds = [_bound(instance, int(low)) for instance, low in zip(instances, reached, strict=True)]
    return np.array(bounds, np.int32)


def _bound(instance: _Instance, low: int) -> int:
    """Return the longest lifetime from ``low`` on that is not refuted."""
    rounds = Rounds(instance.position, instance.covers, ~instance.has_comms, instance.slots_to_expiry)
    high = instance.counting_bound
    if low < high and not _feasible(instance, rounds, low + 1):
        return low
    low = min(low + 1, high) if low < high else low
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if _feasible(instance, rounds, middle) else (low, middle - 1)
    return low


def _feasible(instance: _Instance, rounds: Rounds, lifetime: int) -> bool:
    """Return whether the relaxation admits a lifetime."""
    survive, paid = lifetime - 1, lifetime - instance.unfinished
    slots = max(survive, paid, 1)
    battery = _battery_rows(instance, survive, slots)
    if battery is None:
        return False
    rows, limits = battery
    age = _age_rows(instance, survive, slots)
    energy = np.zeros((1, *rows.shape[1:]))
    energy[0, :paid] = instance.base_power * instance.duration[:paid]
    flights = instance.extra_power * rounds.min_distance(survive) / instance.uav_speed
    budget = instance.uav_battery * (1.0 + _SLACK) - flights * (1.0 - _SLACK)
    if budget <= 0.0:
        return False
    rows = np.concatenate([rows, age, energy / budget])
    return not _refuted(rows, np.concatenate([limits, np.full(len(age), -1.0), [1.0]]))


def _refuted(rows: Float[np.ndarray, "R T n"], limits: Float[np.ndarray, " R"]) -> bool:
    """Return whether no ``x [T, n]`` with ``x >= 0`` and ``x[t].sum() = 1`` satisfies ``rows @ x <= limits``."""
    count, slots, n = rows.shape
    flat = rows.reshape(count, slots * n)
    solution = linprog(
        np.append(np.zeros(slots * n), 1.0),
        A_ub=np.column_stack([flat, np.full(count, -1.0)]),
        b_ub=limits,
        A_eq=np.column_stack([np.kron(np.eye(slots), np.ones(n)), np.zeros(slots)]),
        b_eq=np.ones(slots),
        bounds=[*[(0.0, None)] * (slots * n), (None, None)],
        method="highs-ds",
    )
    if solution.status != _SOLVED:
        return False
    multipliers = np.maximum(-solution.ineqlin.marginals, 0.0)
    least = np.sum(np.min((multipliers @ flat).reshape(slots, n), axis=1))
    return bool(least > multipliers @ limits + _ROUNDING * np.abs(multipliers) @ np.abs(limits))


def _battery_rows(
    instance: _Instance, survive: int, slots: int
) -> tuple[Float[np.ndarray, "R T n"], Float[np.ndarray, " R"]] | None:
    """Return the rows and limits of the batteries: energy, and whole visits with the largest savings counted first.

    ``None`` if a battery runs out even with a service in every slot.
    """
    n = len(instance.capacity)
    rows, limits = [], []
    shortest = instance.duration[:survive].min(axis=1, initial=np.inf)
    for device in np.flatnonzero(~instance.has_power):
        served = instance.covers[:, device]
        capacity, standby = instance.capacity[device] * (1.0 + _SLACK), instance.standby_power[device]
        work, upload = instance.work[:survive, device], instance.upload[:survive, device]
        row = np.zeros((slots, n))
        row[:survive] = standby * instance.duration[:survive] + np.where(served, upload[:, None], work[:, None])
        rows.append(row / capacity)
        limits.append(1.0)
        saved = np.cumsum(np.sort(np.maximum(work - upload, 0.0))[::-1])
        missing = np.sum(standby * shortest + work) - capacity
        visits = 0 if missing < 0 else 1 + int(np.sum(saved <= missing))
        if visits > survive:
            return None
        if visits:
            row = np.zeros((slots, n))
            row[:survive] = -served.astype(float)
            rows.append(row)
            limits.append(-float(visits))
    return np.array(rows).reshape(-1, slots, n), np.array(limits)


def _age_rows(instance: _Instance, survive: int, slots: int) -> Float[np.ndarray, "R T n"]:
    """Return the rows of ``rows @ x <= -1``: any ``slots_to_expiry`` slots serve each device without communication."""
    rows = []
    for device in np.flatnonzero(~instance.has_comms):
        for start in range(survive - instance.slots_to_expiry + 1):
            row = np.zeros((slots, len(instance.capacity)))
            row[start : start + instance.slots_to_expiry] = -instance.covers[:, device].astype(float)
            rows.append(row)
    return np.array(rows).reshape(-1, slots, len(instance.capacity))

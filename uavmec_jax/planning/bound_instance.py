"""One scenario with one volume draw as the upper bound needs it: NumPy, double precision, without padding."""

from collections.abc import Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num

from uavmec_jax.env.dynamics import slots_to_expiry
from uavmec_jax.env.fleet import Depots
from uavmec_jax.env.layout import Layout, fleet_of
from uavmec_jax.env.params import Params
from uavmec_jax.errors import ArgumentError
from uavmec_jax.planning import demand, fleet_demand
from uavmec_jax.planning.hover_sets import MAX_LISTED, number_of_sets

SLACK = 1e-5
"""Relative tolerance for the single precision of the slot's physics, in favour of the network."""


@dataclass(frozen=True)
class Instance:
    """One scenario with one volume draw.

    Attributes:
        position: m; the other attributes of the devices are those of :class:`Layout`.
        hover_points: devices above which UAVs may hover.
        covers: see :func:`demand.coverage`.
        rate: see :func:`demand.upload_rates`.
        t_work: s, time that a device works in each slot if it is not served.
        bits: size of each device's task.
        work: see :class:`demand.SlotCosts`.
        upload: see :class:`demand.SlotCosts`.
        shortest: s, least length of each slot with hover sets of 0, 1, ... K points.
        counting_bound: slots.
        slots_to_expiry: slots after which data expire.
        unfinished: 1 if the slot that the UAVs' batteries do not cover counts, else 0.
        start: m, where each UAV starts.
        speed: m/s, of each UAV.
        battery: J, of each UAV.
        flying_power: W, of each UAV.
        base_power: W, see :func:`demand.flight_power`.
        extra_power: W, see :func:`demand.flight_power`.
        ranges_differ: whether the UAVs' signal ranges do.
        depots: the depots, ``None`` if there are none.
    """

    position: Float[np.ndarray, "n 2"]
    capacity: Float[np.ndarray, " n"]
    standby_power: Float[np.ndarray, " n"]
    has_power: Bool[np.ndarray, " n"]
    has_comms: Bool[np.ndarray, " n"]
    hover_points: Int[np.ndarray, " q"]
    covers: Bool[np.ndarray, "n n"]
    rate: Float[np.ndarray, "n n"]
    t_work: Float[np.ndarray, "H n"]
    bits: Float[np.ndarray, "H n"]
    work: Float[np.ndarray, "H n"]
    upload: Float[np.ndarray, "H n"]
    shortest: Float[np.ndarray, "H sizes"]
    counting_bound: int
    slots_to_expiry: int
    unfinished: int
    start: Float[np.ndarray, "K 2"]
    speed: Float[np.ndarray, " K"]
    battery: Float[np.ndarray, " K"]
    flying_power: Float[np.ndarray, " K"]
    base_power: Float[np.ndarray, " K"]
    extra_power: Float[np.ndarray, " K"]
    ranges_differ: bool
    depots: Depots | None

    @property
    def uavs(self) -> int:
        """Number of UAVs K."""
        return len(self.speed)

    @property
    def is_listed(self) -> bool:
        """Whether there are so few hover sets that they are listed."""
        return number_of_sets(self.uavs, len(self.hover_points)) <= MAX_LISTED

    @property
    def may_decline(self) -> bool:
        """Whether a device in range of a hover set counts as served or not served, whichever helps the network."""
        return self.ranges_differ or not self.is_listed


_OF_UAVS = ("start", "speed", "battery", "flying_power", "base_power", "extra_power")


@jax.jit
@jax.vmap
def _quantities(params: Params, layout: Layout, volumes: Num[Array, "H n"]) -> dict[str, Array]:
    """Compute the fields of :class:`Instance` for ``B`` scenarios, padding included; leaves ``[B, ...]``."""
    costs = fleet_demand.slot_costs(params, layout, volumes)
    t_compute, t_results = demand.work_times(params, layout, volumes)
    fleet = fleet_of(params, layout)
    base, extra = demand.flight_power(params, fleet)
    uavs = fleet_demand.present_uavs(fleet)
    highest, lowest = (jnp.where(uavs, fleet.signal_range_m, fill) for fill in (-jnp.inf, jnp.inf))
    from_layout = ("position", "capacity", "standby_power", "has_power", "has_comms")
    return {name: getattr(layout, name) for name in from_layout} | {
        "present": jnp.ones(layout.n_devices, bool) if layout.present is None else layout.present,
        "covers": demand.coverage(params, layout),
        "rate": demand.upload_rates(params, layout),
        "t_work": t_compute + t_results,
        "bits": 8.0 * volumes,
        "work": costs.work,
        "upload": costs.upload,
        "shortest": fleet_demand.shortest_slots(params, layout, volumes, jnp.arange(layout.n_uavs + 1)),
        "counting_bound": fleet_demand.counting_bound(params, layout, costs),
        "slots_to_expiry": slots_to_expiry(params),
        "unfinished": jnp.where(params.count_unfinished_slot, 1, 0),
        "uavs": uavs,
        "start": fleet.start_m,
        "speed": fleet.speed_m_s,
        "battery": fleet.battery_j,
        "flying_power": fleet.flying_power_w,
        "base_power": base,
        "extra_power": extra,
        "ranges_differ": jnp.max(highest) > jnp.min(lowest),
    }


def instances(params: Params, layouts: Layout, volumes: Num[Array, "B H n"]) -> Iterator[Instance]:
    """Return the instances of ``B`` scenarios; every leaf has a leading ``B``.

    Raises:
        ArgumentError: a quantity overflowed; one line.
    """
    batch = {name: np.asarray(leaf) for name, leaf in _quantities(params, layouts, volumes).items()}
    for name, leaf in batch.items():
        if leaf.dtype == np.float32 and np.isnan(leaf).any():
            raise ArgumentError(f"the scenario makes {name} NaN; its numbers are too large or too small")
    batch = {name: leaf.astype(float) if leaf.dtype == np.float32 else leaf for name, leaf in batch.items()}
    depots = None if layouts.depots is None else jax.tree.map(np.asarray, layouts.depots)
    for number in range(len(volumes)):
        one = {name: leaf[number] if leaf.ndim > 1 else leaf[number].item() for name, leaf in batch.items()}
        uavs = one.pop("uavs")
        one |= {name: one[name][uavs] for name in _OF_UAVS}
        one["hover_points"] = np.flatnonzero(one.pop("present"))
        yield Instance(**one, depots=jax.tree.map(lambda leaf, number=number: leaf[number], depots))

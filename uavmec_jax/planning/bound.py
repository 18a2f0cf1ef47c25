"""A certified upper bound: the lifetime that no policy exceeds on one layout with one volume draw.

A lifetime of k slots requires that every device survives k - 1 slots. Without depots it also requires that a UAV hovers in
all k slots: all that have not been grounded hover in every slot, and a UAV that does not start is grounded. With depots none
has to hover: a UAV that has landed starts into the next slot for nothing, even where there is nothing left to get.

Both requirements are relaxed to a linear program over ``x[t, c]``, the share of slot t in which the fleet uses the hover set
c (:mod:`uavmec_jax.planning.hover_sets`)::

    rows @ x <= limits,    sum_c x[t, c] = 1,    x >= 0.

It is refuted with a certificate (:mod:`uavmec_jax.planning.refutation`). If k slots are refuted, so is every longer lifetime,
and the bound is found by bisection. What a policy does in a slot corresponds to the set of the points above which UAVs hover,
and it satisfies every row:

- *Devices.* A served device is in the set's range. A slot is as long as its slowest device; flights only lengthen it, and
  an upload is as short as to the best point of the set. A battery spends its standby power for that long, and the work or
  at least an upload from right below the UAV (:func:`uavmec_jax.planning.device_rows.add_battery_rows`, which also counts
  whole visits). Data that do not expire are collected in every window of ``slots_to_expiry`` slots.
- *Energy without depots.* The UAVs in the air in a slot have been in the air in all slots before. If they are ``j`` or more,
  one of them has a battery that is no better than the ``j``-th best, and it has paid for all these slots. So hover sets of
  ``j`` or more points are in use no longer than the ``j``-th best battery lasts, and never after it is bound to be empty.
  Nothing is said about a UAV that is grounded early.
- *Energy with depots.* The energy in all batteries when a slot begins is at most their capacity; it pays for those that
  hover in the slot; and it grows by what depots give in the slot to those that do not hover, which helps from the next slot
  on. A swap gives at most a full battery, to as many UAVs as there are pads and, over the whole lifetime, packs; charging
  gives at most its power for the length of the slot, which here has to be the longest that it can have. This accounts for
  every window of slots: what is spent in it was in the batteries before, or was given in it.
- *Flights* cost one UAV at least what :mod:`uavmec_jax.planning.flight` derives for the rounds through the devices without
  communication, and each UAV of a fleet without depots at least its way to the nearest device.

The best of a fleet stands for all of it only in its signal range and in how fast it charges; batteries are counted in seconds
of hovering at each UAV's own least power. Integrality is kept in the rows that count whole visits; measured on top of them
with one UAV, the mixed-integer program gained nothing.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Num

from uavmec_jax.env.checks import check_range
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.scenario_checks import check_scenario
from uavmec_jax.env.slot_checks import check_volume_table
from uavmec_jax.planning.bound_instance import Instance, instances
from uavmec_jax.planning.device_rows import add_age_rows, add_battery_rows
from uavmec_jax.planning.energy_rows import add_depot_rows, add_endurance_rows, endurance
from uavmec_jax.planning.flight import Rounds
from uavmec_jax.planning.hover_sets import HoverSets, ListedHoverSets, LooseHoverSets
from uavmec_jax.planning.refutation import Refuter
from uavmec_jax.planning.requirements import Features, Requirements, Rows


def upper_bound(params: Params, layout: Layout, volumes: Num[Array, "H n"], reached: int = 1) -> int:
    """Return the longest lifetime in slots that cannot be refuted; no policy exceeds it.

    Args:
        params: scenario parameters.
        layout: the devices, the UAVs and the depots.
        volumes: bytes, ``H`` from :func:`uavmec_jax.planning.fleet_demand.planned_slots`.
        reached: a lifetime that some policy reaches; the search starts there and is short if it is optimal.

    Raises:
        ArgumentError: something is not finite or out of range, and a bound would certify nothing; one line.
        ValueError: the volumes end before a lifetime may, or episodes do not end with the first failure.
    """
    check_scenario(params, layout)  # here without the batch's axis, so that the message names the device
    check_volume_table(volumes, layout.n_devices)
    check_range("reached", reached, ge=0, lt=2**31, whole=True)
    params, layout, volumes = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (params, layout, volumes))
    return int(upper_bounds(params, layout, volumes, np.array([reached]))[0])


def upper_bounds(
    params: Params, layouts: Layout, volumes: Num[Array, "B H n"], reached: Num[np.ndarray, " B"]
) -> Int[np.ndarray, " B"]:
    """Return the :func:`upper_bound` of each of ``B`` scenarios; every leaf has a leading ``B``."""
    check_scenario(params, layouts)
    check_range("reached", reached, ge=0, axes=("scenario",))
    check_volume_table(volumes, layouts.n_devices, (len(reached),))
    if params.end != "first_failure":
        raise ValueError(f"end is {params.end!r}; upper bounds on lifetimes are for 'first_failure'")
    slots, max_slots = volumes.shape[1], np.broadcast_to(params.max_slots, len(reached))
    bounds = []
    for instance, low, limit in zip(instances(params, layouts, volumes), reached, max_slots, strict=True):
        if instance.counting_bound >= slots and slots < limit:
            raise ValueError(f"volumes are given for {slots} slots, and lifetimes may be longer; give more")
        bounds.append(_Bound(instance).search(int(low)))
    return np.array(bounds, np.int32)


class _Bound:
    """The search for the bound of one instance."""

    def __init__(self, instance: Instance) -> None:
        self._instance = instance
        self._sets = _hover_sets(instance)
        self._refuter = Refuter(self._sets)
        position, may_land = instance.position, instance.depots is not None
        way = np.linalg.norm(position[instance.hover_points, None] - instance.start, axis=-1).min(axis=0)
        self._nearest = np.zeros(instance.uavs) if may_land else way
        disconnected, expiry = ~instance.has_comms, instance.slots_to_expiry
        self._rounds = Rounds(position, instance.covers, disconnected, expiry, instance.start[0], may_land=may_land)

    def search(self, low: int) -> int:
        """Return the longest lifetime from ``low`` on that is not refuted."""
        high = self._instance.counting_bound
        if low < high and not self._feasible(low + 1):
            return low
        low = min(low + 1, high) if low < high else low
        while low < high:
            middle = (low + high + 1) // 2
            low, high = (middle, high) if self._feasible(middle) else (low, middle - 1)
        return low

    def _feasible(self, lifetime: int) -> bool:
        """Return whether a lifetime is not refuted."""
        requirements = self._requirements(lifetime)
        return requirements is not None and not self._refuter.refutes(requirements)

    def _requirements(self, lifetime: int) -> Requirements | None:
        """Return what a lifetime requires; ``None`` if that is out of the question."""
        instance, shortest = self._instance, self._sets.shortest
        survive = lifetime - 1
        paid = lifetime - instance.unfinished if instance.depots is None else 0
        slots = max(survive, paid, 1)
        rows = Rows(Features(slots, len(instance.capacity), self._sets.sizes))
        if not add_battery_rows(rows, instance, shortest, survive):
            return None
        add_age_rows(rows, instance, survive)
        flights = np.array([self._rounds.min_distance(survive)]) if instance.uavs == 1 else self._nearest
        if instance.depots is not None:
            levels = add_depot_rows(rows, instance, instance.depots, flights)
            seconds = endurance(instance, np.zeros(instance.uavs))
            return rows.build(np.sum(shortest[:slots, None] <= seconds, axis=1), levels)
        seconds = endurance(instance, flights)
        largest = np.sum(np.cumsum(shortest[:slots])[:, None] <= seconds, axis=1)
        if (largest[:paid] < 1).any():
            return None
        add_endurance_rows(rows, seconds, paid)
        return rows.build(np.maximum(largest, 1))


def _hover_sets(instance: Instance) -> HoverSets:
    """Return the hover sets of an instance: listed, or if there are too many, a superset of them."""
    points, may_be_empty = instance.hover_points, instance.depots is not None
    covers = instance.covers[points]
    if not instance.is_listed:
        duration = instance.shortest[:, : min(instance.uavs, len(points)) + 1]
        return LooseHoverSets(covers, duration, may_be_empty=may_be_empty)
    return ListedHoverSets(
        instance.uavs,
        covers,
        instance.rate[points],
        instance.t_work,
        instance.bits,
        may_be_empty=may_be_empty,
        may_decline=instance.may_decline,
    )

"""Measures of service: what an episode brought the devices, and what the UAVs did for it."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from uavmec_jax.env.depots import stands_at
from uavmec_jax.env.dynamics import Cause, State, complete_state, in_service, initial_state
from uavmec_jax.env.fleet import DepotKind
from uavmec_jax.env.layout import Layout, fleet_of
from uavmec_jax.env.params import Params, check_params
from uavmec_jax.env.rollout import Trace

_HIGH_SHARE = 0.95


@struct.dataclass
class ServiceMeasures:
    """Measures of one episode.

    A device-slot is one device in one slot that took place; it is what the state after the slot says. All count the same,
    or each as long as its slot.

    Attributes:
        first_failure_slot: number of slots completed when the first device failed, -1 if none did.
        first_failure_cause: :attr:`Cause.BATTERY` or :attr:`Cause.DATA_AGE`, int32; ``NONE`` if no device failed.
        in_service: share of the device-slots in which the device worked and its data had not expired, weighted.
        mean_age: slots, mean age of the data over the device-slots of devices that worked; NaN without any. The data of a
            device with communication have the age 0.
        age_95: slots; in 95 % of those device-slots, the data were not older.
        flights: takeoffs of all UAVs: slots in which a UAV flew to another place.
        energy_used_j: J that the UAVs used, from their own batteries and from depots.
        packs_used: batteries that depots swapped.
    """

    first_failure_slot: Int[Array, "*batch"]
    first_failure_cause: Int[Array, "*batch"]
    in_service: Float[Array, "*batch"]
    mean_age: Float[Array, "*batch"]
    age_95: Float[Array, "*batch"]
    flights: Int[Array, "*batch"]
    energy_used_j: Float[Array, "*batch"]
    packs_used: Int[Array, "*batch"]


def measure(
    params: Params,
    layout: Layout,
    trace: Trace,
    weight: Float[Array, " n"] | Float[Array, "H n"] | None = None,
    *,
    start: State | None = None,
    by_time: bool = False,
) -> ServiceMeasures:
    """Measure an episode.

    Args:
        params: scenario parameters.
        layout: the devices, the UAVs and the depots.
        trace: its slots, leaves ``[H, ...]``; those that do not belong to the episode count in no measure.
        weight: weight of each device in ``in_service``, the same in all slots or one row per slot, e.g. of its traffic; by
            default its priority. Padding weighs nothing.
        start: the state before the first of the slots; by default the initial one.
        by_time: whether a device-slot counts as long as its slot lasts, until the horizon if there is one. Slots in which
            every device is served are short: of many such slots, an average over slots says little.

    Raises:
        ArgumentError: a parameter is out of range; one line.
    """
    check_params(params)
    happened = trace.played & (trace.outcome.cause != Cause.UAV)
    present = jnp.ones(layout.n_devices, bool) if layout.present is None else layout.present
    counts = jnp.where(happened, seconds_until_horizon(params, trace) if by_time else 1.0, 0.0)[:, None]
    weight = counts * (layout.service_weight() if weight is None else jnp.where(present, weight, 0.0))
    serves = jax.vmap(lambda state: in_service(params, layout, state))(trace.state)
    total = jnp.sum(weight)
    works = present & (trace.state.failed_at < 0)
    mean_age, age_95 = _ages(trace.state.age, jnp.where(works, counts, 0.0))
    slot, cause = _first_failure(trace, happened)
    uavs = uav_slots(params, layout, trace, start)
    return ServiceMeasures(
        first_failure_slot=slot,
        first_failure_cause=cause,
        in_service=jnp.sum(jnp.where(serves, weight, 0.0)) / jnp.where(total > 0, total, 1.0),
        mean_age=mean_age,
        age_95=age_95,
        flights=jnp.sum(uavs.flew, dtype=jnp.int32),
        energy_used_j=jnp.sum(uavs.used_j),
        packs_used=jnp.sum(uavs.swapped, dtype=jnp.int32),
    )


def seconds_until_horizon(params: Params, trace: Trace) -> Float[Array, " H"]:
    """Return how long each slot of an episode lasts, s; what is beyond the horizon, if there is one, does not count."""
    duration = trace.outcome.duration
    if params.end != "horizon":
        return duration
    begins = trace.state.elapsed - duration
    return jnp.clip(params.horizon_s - begins, 0.0, duration)


def _ages(age: Int[Array, "H n"], counts: Float[Array, "H n"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the mean and the 95th percentile (nearest rank) of ages weighted by ``counts``; NaN if all weights are 0."""
    total = jnp.sum(counts)
    order = jnp.argsort(age, axis=None)
    reaches = jnp.cumsum(counts.reshape(-1)[order]) >= _HIGH_SHARE * total * (1.0 - 1e-5)
    high = age.reshape(-1)[order][jnp.argmax(reaches)]
    return jnp.sum(counts * age) / total, jnp.where(total > 0, high.astype(jnp.float32), jnp.nan)


def _first_failure(trace: Trace, happened: Bool[Array, " H"]) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Return the number of slots completed at the first failure, and its cause; -1 and ``NONE`` without a failure."""
    share = trace.outcome.first_failure
    fails = happened & jnp.any(share > 0, axis=1)
    first = jnp.argmax(fails)
    empty = jnp.any((share[first] > 0) & (trace.state.failed_at[first] >= 0))
    slot = jnp.where(jnp.any(fails), trace.state.slot[first], -1)
    cause = jnp.where(empty, Cause.BATTERY, Cause.DATA_AGE)
    return slot, jnp.where(jnp.any(fails), cause, Cause.NONE).astype(jnp.int32)


@struct.dataclass
class UavSlots:
    """What UAVs did in the slots of an episode.

    Attributes:
        flew: whether it flew to another place.
        depot: number of the depot where it stands after the slot, -1 if it stands at none.
        used_j: J that it used.
        refilled_j: J that a depot gave it.
        swapped: whether the depot swapped its battery.
    """

    flew: Bool[Array, "*batch K"]
    depot: Int[Array, "*batch K"]
    used_j: Float[Array, "*batch K"]
    refilled_j: Float[Array, "*batch K"]
    swapped: Bool[Array, "*batch K"]


def uav_slots(params: Params, layout: Layout, trace: Trace, start: State | None = None) -> UavSlots:
    """Return what each UAV did in each slot, leaves ``[H, K]``; ``start`` is the state before the first of the slots.

    A UAV that has landed pays for its flight alone; whatever else its energy changed by came from the depot.
    """
    start = complete_state(layout, initial_state(params, layout) if start is None else start)
    fleet, after = fleet_of(params, layout), trace.state
    position, energy = (
        jnp.concatenate([first[None], then[:-1]])
        for first, then in ((start.uav_position, after.uav_position), (start.uav_energy, after.uav_energy))
    )
    flew = jnp.any(after.uav_position != position, axis=-1)
    distance = jnp.linalg.norm(after.uav_position - position, axis=-1)
    flight = fleet.flying_power_w * (distance / fleet.speed_m_s)
    lost = jnp.maximum(energy - after.uav_energy, 0.0)
    nowhere = jnp.full(flew.shape, -1, jnp.int32)
    if (depots := layout.depots) is None:
        return UavSlots(flew, nowhere, lost, jnp.zeros_like(lost), jnp.zeros_like(flew))
    stands = jax.vmap(lambda position: stands_at(depots, position))(after.uav_position)
    # Above a device that is at a depot, a UAV hovers if it started: then it lost energy.
    to_device = trace.action.reshape(flew.shape) < layout.n_devices
    stands &= ~(after.grounded | (to_device & (lost > 0)))[..., None]
    landed = jnp.any(stands, axis=-1)
    refilled = jnp.where(landed, jnp.maximum(after.uav_energy - (energy - flight), 0.0), 0.0)
    swaps = jnp.any(stands & (depots.kind == DepotKind.SWAP), axis=-1)
    return UavSlots(
        flew=flew,
        depot=jnp.where(landed, jnp.argmax(stands, axis=-1).astype(jnp.int32), nowhere),
        used_j=jnp.where(landed, flight, lost),
        refilled_j=refilled,
        swapped=swaps & (energy - flight < fleet.battery_j) & (after.uav_energy >= fleet.battery_j),
    )

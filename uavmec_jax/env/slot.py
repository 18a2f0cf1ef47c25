"""One slot's flights and services: which UAVs start and which devices they serve, how long the slot lasts, what it costs."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from uavmec_jax.env.channel import upload_rate
from uavmec_jax.env.fleet import Fleet
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params

_UNROLLED = 4
"""UAVs up to which the rounds of :func:`who_starts` are unrolled; a loop that can end early is faster for more."""


class Flights(NamedTuple):
    """What the UAVs are about to do in a slot, whether they can pay for it or not.

    Attributes:
        place: position of each UAV's target, m.
        hovers: whether the target is a device, above which the UAV hovers; it lands at a depot.
        t_fly: s.
        covers: which devices each UAV would serve.
        t_upload: s, time of each device's upload to each UAV.
        t_work: s, time that each device works in the slot if it is not served.
        t_compute: s, the part of it that is computing.
        t_results: s, the part of it that sends results.
    """

    place: Float[Array, "K 2"]
    hovers: Bool[Array, " K"]
    t_fly: Float[Array, " K"]
    covers: Bool[Array, "K n"]
    t_upload: Float[Array, "K n"]
    t_work: Float[Array, " n"]
    t_compute: Float[Array, " n"]
    t_results: Float[Array, " n"]


class Services(NamedTuple):
    """What happens in a slot if certain UAVs start.

    Attributes:
        served: which devices are served.
        t_upload: s, upload time of each served device, to the UAV at which its upload finishes first.
        duration: s, length of the slot.
        cost: J, what the slot costs each UAV that starts.
    """

    served: Bool[Array, " n"]
    t_upload: Float[Array, " n"]
    duration: Float[Array, ""]
    cost: Float[Array, " K"]


def plan_flights(
    params: Params,
    layout: Layout,
    fleet: Fleet,
    uav_position: Float[Array, "K 2"],
    target: Int[Array, " K"],
    volumes: Num[Array, " n"],
) -> Flights:
    """Return the flights to the UAVs' targets, places in ``[0, n + D)``, and the services that they would bring."""
    n = layout.n_devices
    place = layout.places()[target]
    hovers = target < n if layout.n_depots else jnp.ones(target.shape, bool)
    ground = layout.position - place[:, None]
    slant = jnp.sqrt(jnp.sum(ground**2, axis=-1) + params.uav_altitude_m**2)
    covers = (slant <= fleet.signal_range_m[:, None]) | (jnp.arange(n) == target[:, None])
    t_compute = jnp.minimum(volumes / layout.processing_rate, params.slot_cap_s)
    t_results = result_times(params, layout)
    return Flights(
        place=place,
        hovers=hovers,
        t_fly=jnp.linalg.norm(place - uav_position, axis=-1) / fleet.speed_m_s,
        covers=covers & hovers[:, None],
        t_upload=8.0 * volumes / upload_rate(params, slant),
        t_work=t_compute + t_results,
        t_compute=t_compute,
        t_results=t_results,
    )


def result_times(params: Params, layout: Layout) -> Float[Array, " n"]:
    """Return the seconds in which each device that is not served sends its results: if it is connected, and not padding."""
    sends = layout.has_comms if layout.present is None else layout.has_comms & layout.present
    return jnp.where(sends, 8.0 * params.result_message_bytes / params.uplink_rate_bit_s, 0.0)


def services_of(
    params: Params, fleet: Fleet, flights: Flights, living: Bool[Array, " n"] | None, started: Bool[Array, " K"] | None
) -> Services:
    """Return what happens in a slot.

    Args:
        params: simulation parameters.
        fleet: the UAVs.
        flights: see :func:`plan_flights`.
        living: devices that work; ``None`` if all do.
        started: UAVs that start. ``None``: the only UAV of a scenario without depots; if it does not start, there is no slot.
    """
    covers = flights.covers if started is None else flights.covers & started[:, None]
    covers = covers if living is None else covers & living
    served = jnp.any(covers, axis=0)
    through = jnp.where(covers, flights.t_fly[:, None] + flights.t_upload, jnp.inf)
    busy = jnp.where(served, jnp.min(through, axis=0), flights.t_work)
    duration = jnp.max(busy if living is None else jnp.where(living, busy, -jnp.inf))
    if started is not None:  # (alone, a UAV serves its target, which takes longer than the flight)
        longest_flight = jnp.max(jnp.where(started, flights.t_fly, 0.0))
        if living is not None:
            duration = jnp.where(jnp.any(living), duration, params.slot_cap_s)
        duration = jnp.maximum(duration, longest_flight)
    t_hover = duration - jnp.where(params.flight_power_adds_to_hover, 0.0, flights.t_fly)
    hovering = jnp.where(flights.hovers, fleet.hovering_power_w * t_hover, 0.0)
    return Services(
        served=served,
        t_upload=_of_first(through, flights.t_upload),
        duration=duration,
        cost=fleet.flying_power_w * flights.t_fly + hovering,
    )


def _of_first(through: Float[Array, "K n"], value: Float[Array, "K n"]) -> Float[Array, " n"]:
    """Return each device's value at the UAV at which its upload finishes first, the lowest one of several."""
    if through.shape[0] == 1:
        return value[0]
    is_first = jnp.argmin(through, axis=0) == jnp.arange(through.shape[0])[:, None]
    return jnp.sum(jnp.where(is_first, value, 0.0), axis=0)


def who_starts(
    fleet: Fleet,
    flights: Flights,
    energy: Float[Array, " K"],
    able: Bool[Array, " K"],
    services: Callable[[Bool[Array, " K"]], Services],
) -> Bool[Array, " K"]:
    """Return the UAVs that start: those that can pay for their own flight and then for the slot that results.

    Those that cannot pay for a slot are left out together, which changes the slot for the others; then it is computed
    again, until all the others can pay.
    """

    def can_pay(started: Bool[Array, " K"]) -> Bool[Array, " K"]:
        return started & (energy >= services(started).cost)

    started = able & (energy >= fleet.flying_power_w * flights.t_fly)
    uavs = started.shape[0]
    if uavs <= _UNROLLED:
        for _ in range(uavs):
            started = can_pay(started)
        return started

    def again(rounds: tuple[Array, Array]) -> tuple[Array, Array]:
        return can_pay(rounds[0]), rounds[0]

    differ = lambda rounds: jnp.any(rounds[0] != rounds[1])  # noqa: E731
    return jax.lax.while_loop(differ, again, (can_pay(started), started))[0]

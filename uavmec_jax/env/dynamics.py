"""The dynamics of one time slot, a pure function of explicit task volumes (paper, sections 3.1 and 4)."""

import enum
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from uavmec_jax.env.checks import check_ranges
from uavmec_jax.env.depots import can_help, serve_landed, stands_at
from uavmec_jax.env.fleet import Fleet
from uavmec_jax.env.layout import Layout, fleet_of
from uavmec_jax.env.params import Params, check_params
from uavmec_jax.env.scenario_checks import check_scenario
from uavmec_jax.env.slot import Flights, Services, plan_flights, services_of, who_starts
from uavmec_jax.env.slot_checks import action_check, volumes_check
from uavmec_jax.env.state_checks import state_checks
from uavmec_jax.env.types import Scalar
from uavmec_jax.errors import ArgumentError


class Cause(enum.IntEnum):
    """Why an episode ended."""

    NONE = 0
    """It has not ended."""
    BATTERY = 1
    """A device's battery is empty (constraint 1e)."""
    DATA_AGE = 2
    """A device's data are too old (constraint 1g)."""
    UAV = 3
    """No UAV's battery covers the next slot, and none stands at a depot that can still help."""
    HORIZON = 4
    """The time of an episode with ``end = "horizon"`` is over."""
    SHARE = 5
    """So many batteries are empty that an episode with ``end = "horizon"`` is over."""


@struct.dataclass
class State:
    """The state of the network between two slots.

    Attributes:
        battery: energy left in each device, J.
        age: slots since each device's data were last delivered, int32.
        uav_position: position of each UAV, m.
        uav_energy: energy left in each UAV, J.
        slot: slots completed, int32.
        elapsed: total length of the slots completed, s.
        grounded: UAVs that could not pay for a slot and are out for the rest of the episode; ``None``: none.
        failed_at: value of ``slot`` after the slot in which each battery ran out, -1 for devices that are alive;
            ``None``: all are.
        packs: full batteries in stock at each depot; ``None``: those of the start.
    """

    battery: Float[Array, "*batch n"]
    age: Int[Array, "*batch n"]
    uav_position: Float[Array, "*batch K 2"]
    uav_energy: Float[Array, "*batch K"]
    slot: Int[Array, "*batch"]
    elapsed: Scalar = 0.0
    # The last three may be left out; complete_state puts them in.
    grounded: Bool[Array, "*batch K"] = None  # type: ignore[assignment]
    failed_at: Int[Array, "*batch n"] = None  # type: ignore[assignment]
    packs: Float[Array, "*batch D"] = None  # type: ignore[assignment]


@struct.dataclass
class Outcome:
    """The result of one slot.

    Attributes:
        cause: why the episode ended with this slot, a :class:`Cause` as int32.
        failed: devices that failed in this slot: their battery ran out or their data expired.
        served: living devices that upload in this slot: in range of a hovering UAV, or its target.
        duration: length of the slot, s; 0 if it never started.
        first_failure: each device's share in the first failure. Shares sum to 1 if a device failed: the battery that
            runs out earliest inside the slot has all of it; devices whose data expired share it equally.
        lasted: share of the slot that was over when the first battery ran out, 1 if none did.
    """

    cause: Int[Array, "*batch"]
    failed: Bool[Array, "*batch n"]
    served: Bool[Array, "*batch n"]
    duration: Float[Array, "*batch"]
    first_failure: Float[Array, "*batch n"]
    lasted: Scalar = 1.0


def initial_state(params: Params, layout: Layout) -> State:
    """Return the state before the first slot: full batteries, fresh data, every UAV where it starts.

    Raises:
        ArgumentError: a parameter or a value of the layout is out of range; one line. Traced ones are not checked.
    """
    if not isinstance(layout.capacity, jax.core.Tracer):
        check_scenario(params, layout)
    return fresh_state(params, layout)


def fresh_state(params: Params, layout: Layout) -> State:
    """Return the state before the first slot, unchecked."""
    fleet = fleet_of(params, layout)
    state = State(
        battery=jnp.asarray(layout.capacity, jnp.float32),
        age=jnp.zeros(layout.capacity.shape, jnp.int32),
        uav_position=jnp.asarray(fleet.start_m, jnp.float32),
        uav_energy=jnp.asarray(fleet.battery_j, jnp.float32),
        slot=jnp.zeros((), jnp.int32),
        elapsed=jnp.zeros((), jnp.float32),
    )
    return complete_state(layout, state)


def complete_state(layout: Layout, state: State) -> State:
    """Return a state with the fields that were left out: no UAV grounded but padding, all devices alive, all packs there."""
    packs = jnp.zeros(0, jnp.float32) if layout.depots is None else jnp.asarray(layout.depots.packs, jnp.float32)
    absent = jnp.zeros(layout.n_uavs, bool)
    if layout.fleet is not None and layout.fleet.present is not None:
        absent = ~layout.fleet.present
    defaults = {
        "grounded": absent,
        "failed_at": jnp.full(layout.n_devices, -1, jnp.int32),
        "packs": packs,
    }
    return replace(state, **{name: value for name, value in defaults.items() if getattr(state, name) is None})


def slots_to_expiry(params: Params) -> Int[Array, "*batch"]:
    """Return after how many slots without service fresh data expire: 11 with the paper's limit of 10."""
    return jnp.where(params.age_at_limit_fails, params.data_age_limit_slots, params.data_age_limit_slots + 1)


def in_service(params: Params, layout: Layout, state: State) -> Bool[Array, " n"]:
    """Return the devices that work and whose data have not expired."""
    return _living(layout, state) & (state.age < slots_to_expiry(params))


def service(params: Params, layout: Layout, state: State) -> Float[Array, ""]:
    """Return the share of the devices that are :func:`in_service`, weighted by their priorities."""
    weight = layout.service_weight()
    total = jnp.sum(weight)
    return jnp.sum(jnp.where(in_service(params, layout, state), weight, 0.0)) / jnp.where(total > 0, total, 1.0)


def living_devices(params: Params, layout: Layout, state: State) -> Bool[Array, " n"] | None:
    """Return the devices that work in the next slot; ``None`` if all do, because the first failure ends the episode."""
    return None if params.end == "first_failure" else _living(layout, state)


def _living(layout: Layout, state: State) -> Bool[Array, " n"]:
    alive = complete_state(layout, state).failed_at < 0
    return alive if layout.present is None else alive & layout.present


def transition(
    params: Params,
    layout: Layout,
    state: State,
    action: Num[ArrayLike, ""] | Num[Array, " K"],
    volumes: Num[Array, " n"],
) -> tuple[State, Outcome]:
    """Let every UAV fly to a place, serve all devices in range, let the others compute, and check for failures.

    Args:
        params: scenario parameters.
        layout: the devices, the UAVs and the depots, without batch axes (use ``vmap``).
        state: the state before the slot.
        action: the place that each UAV flies to: a device in ``[0, n)`` or a depot in ``[n, n + D)``; staying is allowed.
            A scalar if there is one UAV. If it is traced, out of range is clamped.
        volumes: ``[n]`` bytes, each device's task in this slot.

    Returns:
        The state after the slot and its :class:`Outcome`. If no UAV's battery covers the slot and no depot helps, nothing
        happens in it, and the cause is :attr:`Cause.UAV`; under ``end = "horizon"`` it goes on without UAVs.

    Raises:
        ArgumentError: a shape is wrong, or the action, a volume or a value of the parameters or the state is out of range;
            one line. Traced values are checked only inside :func:`um.debug_checks`.
    """
    _check_slot(params, layout, state, action, volumes)
    state, fleet = complete_state(layout, state), fleet_of(params, layout)
    living = living_devices(params, layout, state)
    target = jnp.clip(jnp.atleast_1d(action), 0, layout.n_places - 1)
    flights = plan_flights(params, layout, fleet, state.uav_position, target, volumes)
    services = partial(services_of, params, fleet, flights, living)

    if (
        layout.n_uavs == 1 and not layout.n_depots and living is None
    ):  # the paper's model: the UAV starts or nothing does
        slot = services(None)
        happens = (~state.grounded & (state.uav_energy >= slot.cost))[0]
        started = jnp.ones(1, bool)
    else:
        started = who_starts(fleet, flights, state.uav_energy, ~state.grounded, services)
        slot = services(started)
        happens = jnp.any(started) | _helped(layout, state) if living is None else jnp.asarray(True)

    after, drain = _play(params, layout, fleet, state, flights, slot, started, living)
    unstarted = replace(state, slot=state.slot + jnp.where(params.count_unfinished_slot, 1, 0))
    after = jax.tree.map(lambda played, kept: jnp.where(happens, played, kept), after, unstarted)
    return after, _outcome(params, layout, state, after, happens, slot, drain, living)


def _check_slot(params: Params, layout: Layout, state: State, action: Any, volumes: Any) -> None:
    """Check what goes into a slot: shapes, and the values that are known."""
    check_params(params)
    check_ranges([action_check(action, layout.n_places), volumes_check(volumes), *state_checks(state)])
    n, uavs = layout.n_devices, layout.n_uavs
    for name, value, shape, what in (
        ("layout.capacity", layout.capacity, (n,), "one per device"),
        ("state.battery", state.battery, (n,), "one per device"),
        ("state.age", state.age, (n,), "one per device"),
        ("volumes", volumes, (n,), "one per device"),
        ("action", action, (uavs,) if uavs > 1 or np.ndim(action) else (), "one place per UAV"),
    ):
        if np.shape(value) != shape:
            raise ArgumentError(f"{name} has shape {np.shape(value)}; it should be {shape}, {what}")


def _helped(layout: Layout, state: State) -> Bool[Array, ""]:
    """Return whether a UAV stands at a depot that can still swap or charge its battery."""
    if layout.depots is None:
        return jnp.asarray(False)
    stands = stands_at(layout.depots, state.uav_position) & ~state.grounded[:, None]
    return jnp.any(stands & can_help(layout.depots, state.packs))


def _play(
    params: Params,
    layout: Layout,
    fleet: Fleet,
    state: State,
    flights: Flights,
    slot: Services,
    started: Bool[Array, " K"],
    living: Bool[Array, " n"] | None,
) -> tuple[State, Float[Array, " n"]]:
    """Return the state after a slot, and the energy in J that each device used in it."""
    work = jnp.where(
        slot.served,
        params.transmit_power_w * slot.t_upload,
        layout.active_power * flights.t_compute + params.transmit_power_w * flights.t_results,
    )
    idle = layout.has_power if living is None else layout.has_power | ~living
    drain = jnp.where(idle, 0.0, layout.standby_power * slot.duration + work)
    battery = jnp.maximum(state.battery - drain, 0.0)
    age = jnp.where(slot.served, 0, state.age + jnp.where(layout.has_comms, 0, 1))
    empty = battery <= 0.0 if living is None else living & (battery <= 0.0)
    position = jnp.where(started[:, None], flights.place, state.uav_position)
    energy = state.uav_energy - jnp.where(started, slot.cost, 0.0)
    grounded, packs = state.grounded | ~started, state.packs
    if layout.depots is not None:
        stood = stands_at(layout.depots, state.uav_position) & ~state.grounded[:, None]
        grounded = state.grounded | ~(started | jnp.any(stood, axis=1))
        lands = stands_at(layout.depots, position) & jnp.where(started, ~flights.hovers, ~grounded)[:, None]
        seconds = slot.duration - jnp.where(started, flights.t_fly, 0.0)
        energy, packs = serve_landed(layout.depots, packs, lands, energy, fleet.battery_j, seconds)
    after = State(
        battery=battery,
        age=age if living is None else jnp.where(living, age, state.age),
        uav_position=position,
        uav_energy=energy,
        slot=state.slot + 1,
        elapsed=state.elapsed + slot.duration,
        grounded=grounded,
        failed_at=jnp.where(empty & (state.failed_at < 0), state.slot + 1, state.failed_at),
        packs=packs,
    )
    return after, drain


def _outcome(
    params: Params,
    layout: Layout,
    before: State,
    after: State,
    happens: Bool[Array, ""],
    slot: Services,
    drain: Float[Array, " n"],
    living: Bool[Array, " n"] | None,
) -> Outcome:
    """Check for failures after the slot; an empty battery takes precedence over expired data."""
    empty = happens & (after.battery <= 0.0)
    expired = happens & (after.age >= slots_to_expiry(params))
    if living is not None:
        empty, expired = empty & living, expired & living & (before.age < slots_to_expiry(params))
        cause = _cause_at_horizon(params, layout, after)
    else:
        failure = jnp.where(jnp.any(empty), Cause.BATTERY, jnp.where(jnp.any(expired), Cause.DATA_AGE, Cause.NONE))
        cause = jnp.where(happens, failure, Cause.UAV)
    # Mean power over the slot is drain / duration, so a battery lasts battery / drain of the slot.
    lasts = jnp.where(empty, before.battery / jnp.where(empty, drain, 1.0), jnp.inf)
    first = jnp.where(jnp.any(empty), empty & (lasts <= jnp.min(lasts)), expired)
    return Outcome(
        cause=cause.astype(jnp.int32),
        failed=empty | expired,
        served=slot.served & happens,
        duration=jnp.where(happens, slot.duration, 0.0),
        first_failure=first / jnp.maximum(jnp.sum(first), 1),
        lasted=jnp.minimum(jnp.min(lasts), 1.0),
    )


def _cause_at_horizon(params: Params, layout: Layout, after: State) -> Int[Array, ""]:
    """Return why an episode ends that no failure ends: enough devices have an empty battery, or its time is over."""
    present = jnp.ones(layout.n_devices, bool) if layout.present is None else layout.present
    dead = jnp.sum(present & (after.failed_at >= 0))
    enough = dead >= jnp.ceil(params.end_share * jnp.sum(present) - 1e-6)
    return jnp.where(enough, Cause.SHARE, jnp.where(after.elapsed >= params.horizon_s, Cause.HORIZON, Cause.NONE))

"""The full observation: what a UAV can know about every device before a slot's task volumes are known.

The paper's observation (:func:`uavmec_jax.env.environment.observe`) holds batteries and ages alone, so that a policy on it
is made for one layout. This one also says where, what and how much for every device, so that one policy can serve any
layout. All of it follows from the parameters, the layout, the state and the *expected* task volumes; nothing of the slot
to come is in it.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from uavmec_jax.env.dynamics import State, slots_to_expiry
from uavmec_jax.env.fixed_point import order_independent_sum
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning import deadlines, demand

_LONG = 32.0
"""Slots by which lives are scaled: about what the UAV's battery lasts at the paper's settings."""


class Feature(NamedTuple):
    """One number of the full observation: its name, its unit and scale, and where it comes from."""

    name: str
    unit: str
    source: str


FEATURES: tuple[Feature, ...] = (
    Feature("lacks_power", "0 or 1", "delta_E, paper section 3.1"),
    Feature("lacks_comms", "0 or 1", "delta_C, paper section 3.1"),
    Feature("life_unvisited", "32 slots, at most 2", "battery over expected use if never served, equation (1d)"),
    Feature("life_visited", "32 slots, at most 2", "battery over expected use if served in every slot"),
    Feature("saving", "share of the energy of a slot", "what a service saves, Tables 2-3"),
    Feature("services", "per slot hoped for", "services the battery needs to last as long as is hoped for, whole"),
    Feature("missing", "8 services, -2 to 2", "the same before rounding; negative where energy is left over"),
    Feature("age", "share of the limit", "data age, equation (1f)"),
    Feature("due", "share of the limit, 2 for never", "slots until its data expire"),
    Feature(
        "crowding",
        "share of the limit",
        "visits due no later (shared ones in parts), minus the slots until then",
    ),
    Feature("due_rank", "share of devices", "data that expire earlier"),
    Feature("empties_rank", "share of devices", "batteries in need of services that empty earlier"),
    Feature("flight", "expected slots, at most 2", "flight time from the UAV over the length of the slot there"),
    Feature("here", "0 or 1", "the UAV hovers above it"),
    Feature("together", "4 devices", "devices in need that are served from here, equation (4)"),
    Feature("oldest_served", "share of the limit", "oldest data fetched from here"),
    Feature("slot_length", "share of the longest", "expected length of a slot with the UAV here"),
    Feature("uav_use", "share of what is left", "expected energy that a visit here takes from the UAV, equation (1c)"),
    Feature("spare_after", "slots, /8, -2 to 2", "slots left over, at the life hoped for, after a visit here"),
    Feature("crowding_after", "share of the limit", "the tightest due date after a visit here"),
    Feature("on_time_after", "0 or 1", "whether all data can still be fetched in time after a visit here"),
    Feature("traffic_price", "8 slots", "traffic weight times the price of a first failure there"),
    Feature("hoped", "32 slots", "the longest life into which all visits needed still fit"),
    Feature("uav_life", "32 slots, at most 2", "slots that the UAV's battery can pay for"),
    Feature("spare", "share of the life hoped for", "slots that are not needed for any visit"),
    Feature("can_wait", "0 or 1", "whether the data can spare a slot"),
    Feature("all_lack_power", "share of devices", "devices without power"),
    Feature("all_lack_comms", "share of devices", "devices without communication"),
    Feature("devices", "log2, /6", "number of devices"),
)
"""The features of each device, in their order; the last seven are the same for all devices of a scenario."""


@struct.dataclass
class Observation:
    """The full observation of one state.

    Attributes:
        features: ``[n, F]`` f32, see :data:`FEATURES`; zero where there is no device.
        mask: ``[n]`` bool, which entries are devices (layouts may be padded, see :func:`um.env.pad_layout`).
    """

    features: Any
    mask: Any


def observe_devices(params: Params, layout: Layout, state: State) -> Observation:
    """The full observation of a state, from what is known before the slot's task volumes are.

    Args:
        params: scenario parameters.
        layout: ``n`` devices, some of which may be padding.
        state: before the slot.
    """
    n = layout.capacity.shape[0]
    mask = jnp.ones(n, bool) if layout.present is None else layout.present
    count = jnp.sum(mask).astype(jnp.float32)
    known = _Known.of(params, layout)
    slots, services = deadlines.feasible_horizon(params, layout, state, known.mean, known.visit_share)
    everyone = _globals(params, layout, state, known, slots, services, count)
    own = _own(params, layout, state, known, slots, services, mask)
    features = jnp.concatenate([own, jnp.broadcast_to(everyone, (n, everyone.shape[0]))], axis=-1)
    return Observation(features=jnp.where(mask[:, None], features, 0.0), mask=mask)


class _Known(NamedTuple):
    """What follows from parameters and layout alone."""

    mean: Any
    covers: Any
    visit_share: Any
    drain: Any
    use: Any

    @classmethod
    def of(cls, params: Params, layout: Layout) -> "_Known":
        covers = demand.coverage(params, layout)
        mean = demand.mean_slot(params, layout)
        # [a, d] J that device d is expected to use in a slot with the UAV above device a.
        work = jnp.where(covers, mean.upload, mean.work)
        use = jnp.where(layout.has_power, 0.0, layout.standby_power * mean.duration[:, None] + work)
        return cls(
            mean=mean,
            covers=covers,
            # In steps of 2**-16 sums of visit_shares are exact, so they do not depend on the order of the devices.
            visit_share=jnp.floor(demand.visit_shares(layout, covers) * 65536.0) / 65536.0,
            drain=demand.idle_drain(layout, mean),
            use=use,
        )


def _own(
    params: Params, layout: Layout, state: State, known: _Known, slots: Any, services: Array, mask: Bool[Array, " n"]
) -> Float[Array, "n own"]:
    """What differs between devices."""
    mean, needy_comms, count = known.mean, ~layout.has_comms, jnp.sum(mask)
    expiry = jnp.maximum(slots_to_expiry(params), 1).astype(jnp.float32)
    age = jnp.where(needy_comms, state.age, 0).astype(jnp.float32)
    unpowered = lambda value, otherwise: jnp.where(layout.has_power, otherwise, value)  # noqa: E731
    shortest = jnp.min(mean.duration)
    visited = layout.standby_power * shortest + mean.upload
    saving = jnp.maximum(mean.work - mean.upload, 0.0)
    missing = (slots * known.drain - state.battery) / jnp.maximum(saving, 1e-3)
    due = _due(params, layout, state.age)
    load = demand.load_by_due(due, known.visit_share)
    empties = jnp.where(services > 0, state.battery / jnp.maximum(known.drain, 1e-6), jnp.inf)
    t_fly = jnp.linalg.norm(layout.position - state.uav_position, axis=-1) / params.uav_speed_m_s
    base, extra = demand.flight_power(params)
    spare_after, crowding_after = _after(params, layout, state, known, slots)
    together = known.covers & (~layout.has_power | needy_comms)
    columns = [
        unpowered(1.0, 0.0),
        needy_comms,
        unpowered(jnp.minimum(state.battery / jnp.maximum(known.drain, 1e-3) / _LONG, 2.0), 2.0),
        unpowered(jnp.minimum(state.battery / jnp.maximum(visited, 1e-3) / _LONG, 2.0), 2.0),
        unpowered(saving / jnp.maximum(known.drain, 1e-3), 0.0),
        services / slots,
        unpowered(jnp.clip(missing / 8.0, -2.0, 2.0), -2.0),
        age / expiry,
        jnp.where(needy_comms, due / expiry, 2.0),
        jnp.where(needy_comms, jnp.clip((load - due) / expiry, -2.0, 2.0), -2.0),
        _rank(due) / count,
        jnp.where(services > 0, _rank(empties) / count, 1.0),
        jnp.minimum(t_fly / jnp.maximum(mean.duration, 1e-3), 2.0),
        t_fly <= 0.0,
        jnp.sum(together, axis=1) / 4.0,
        jnp.max(jnp.where(known.covers, age, 0.0), axis=1) / expiry,
        mean.duration / jnp.maximum(jnp.max(jnp.where(mask, mean.duration, 0.0)), 1e-3),
        jnp.minimum((base * mean.duration + extra * t_fly) / jnp.maximum(state.uav_energy, 1.0), 1.0),
        jnp.clip(spare_after / 8.0, -2.0, 2.0),
        jnp.clip(crowding_after / expiry, -2.0, 2.0),
        crowding_after <= 0.0,
        layout.failure_price(state.elapsed) / 8.0,
    ]
    return jnp.stack([jnp.asarray(column, jnp.float32) for column in columns], axis=-1)


def _due(params: Params, layout: Layout, age: Array) -> Float[Array, "*b n"]:
    """Slots until each device's data expire; :data:`demand.NEVER` with communication."""
    return jnp.where(layout.has_comms, demand.NEVER, slots_to_expiry(params) - age).astype(jnp.float32)


def _rank(value: Float[Array, " n"]) -> Float[Array, " n"]:
    """How many entries are smaller than each."""
    return jnp.sum(value[None, :] < value[:, None], axis=1).astype(jnp.float32)


def _after(params: Params, layout: Layout, state: State, known: _Known, slots: Any) -> tuple[Array, Array]:
    """After a visit to each device, ``[n]``: spare slots at the life hoped for, and how tight the tightest due date is."""
    battery = state.battery - known.use
    age = jnp.where(known.covers, 0, state.age + jnp.where(layout.has_comms, 0, 1))
    left = jnp.maximum(slots - 1.0, 1.0)
    saving = jnp.maximum(known.mean.work - known.mean.upload, 1e-3)
    missing = (left * known.drain - battery) / saving
    services = jnp.where(layout.has_power, 0.0, jnp.maximum(missing, 0.0))
    turns, _ = demand.age_visits(params, layout, age, left)
    spare = left - order_independent_sum(jnp.maximum(services, turns) * known.visit_share)
    due = _due(params, layout, age)
    load = demand.load_by_due(due, known.visit_share)
    tight = jnp.max(jnp.where(due < demand.NEVER, load - due, -2.0 * 64), axis=-1)
    return spare, tight


def _globals(
    params: Params, layout: Layout, state: State, known: _Known, slots: Any, services: Array, count: Array
) -> Float[Array, " everyone"]:
    """What is the same for all devices."""
    base, _ = demand.flight_power(params)
    uav_slots = state.uav_energy / jnp.maximum(base * jnp.min(known.mean.duration), 1e-3)
    fresh, _ = demand.age_visits(params, layout, state.age, slots)
    needed = order_independent_sum(jnp.maximum(services, fresh) * known.visit_share)
    due = _due(params, layout, state.age)
    falls_due = due <= slots
    load = demand.load_by_due(jnp.where(falls_due, due, demand.NEVER), known.visit_share)
    return jnp.stack(
        [
            slots / _LONG,
            jnp.minimum(uav_slots / _LONG, 2.0),
            (slots - needed) / slots,
            jnp.all(~falls_due | (load + 1.0 <= due)).astype(jnp.float32),
            jnp.sum(~layout.has_power) / count,
            jnp.sum(~layout.has_comms) / count,
            jnp.log2(count) / 6.0,
        ]
    )

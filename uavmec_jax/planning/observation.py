"""The full observation: all that a UAV can know about every device before the task volumes of a slot are known.

The paper's observation (:func:`uavmec_jax.env.observation.observe_as_paper`) holds batteries and ages alone, so a policy
trained on it is bound to one layout. The full observation also tells where the devices are, what they lack and how much
energy they use, so that one policy can serve any layout. Everything in it follows from the parameters, the layout, the state
and the *expected* task volumes; it contains nothing of the slot to come.
"""

from typing import NamedTuple

import chex
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from uavmec_jax.env.dynamics import State, slots_to_expiry
from uavmec_jax.env.fixed_point import order_independent_sum
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.scenario_checks import check_scenario
from uavmec_jax.env.state_checks import check_state
from uavmec_jax.planning import deadlines, demand
from uavmec_jax.planning.demand import SlotCosts

_LIFETIME_SCALE = 32.0
"""Slots that lifetimes are divided by: about as long as the UAV's battery lasts at the paper's settings."""

_NO_CROWDING = -128.0
"""Slots: the crowding of the tightest deadline if there are no deadlines."""


class Feature(NamedTuple):
    """One feature of the full observation: its name, its unit or scale, and its meaning with its source in the paper."""

    name: str
    unit: str
    source: str


FEATURES: tuple[Feature, ...] = (
    Feature("lacks_power", "0 or 1", "delta_E, paper section 3.1"),
    Feature("lacks_comms", "0 or 1", "delta_C, paper section 3.1"),
    Feature("life_unvisited", "32 slots, at most 2", "battery over expected use if never served, equation (1d)"),
    Feature("life_visited", "32 slots, at most 2", "battery over expected use if served in every slot"),
    Feature("saving", "share of a slot's energy", "energy that a service saves, Tables 2-3"),
    Feature("services", "per slot of the horizon", "services its battery needs to survive the feasible horizon, whole"),
    Feature("missing", "8 services, -2 to 2", "the same before rounding; negative if energy is left over"),
    Feature("age", "share of slots to expiry", "data age, equation (1f)"),
    Feature("due", "share of slots to expiry, 2 for never", "slots until its data expire"),
    Feature("crowding", "share of slots to expiry", "visits due no later (shared ones in part) minus slots until then"),
    Feature("due_rank", "share of the devices", "devices whose data expire earlier"),
    Feature("empties_rank", "share of the devices", "batteries in need of services that run out earlier"),
    Feature("flight", "expected slots, at most 2", "flight time from the UAV over the length of the slot there"),
    Feature("here", "0 or 1", "whether the UAV hovers above it"),
    Feature("together", "4 devices", "devices without power or communication that are served from here, equation (4)"),
    Feature("oldest_served", "share of slots to expiry", "age of the oldest data collected from here"),
    Feature("slot_length", "share of the longest", "expected length of a slot with the UAV here"),
    Feature("uav_use", "share of the energy left", "expected energy that a visit here costs the UAV, equation (1c)"),
    Feature("spare_after", "8 slots, -2 to 2", "slots of the horizon not needed for visits, after a visit here"),
    Feature("crowding_after", "share of slots to expiry", "crowding of the tightest deadline, after a visit here"),
    Feature("on_time_after", "0 or 1", "whether all data can still be collected in time after a visit here"),
    Feature("traffic_price", "8 slots", "traffic weight times the price of a first failure there"),
    Feature("hoped", "32 slots", "the feasible horizon: the most slots into which all visits needed fit"),
    Feature("uav_life", "32 slots, at most 2", "slots that the UAV's energy can pay for"),
    Feature("spare", "share of the horizon", "slots of the feasible horizon not needed for visits"),
    Feature("can_wait", "0 or 1", "whether the data can spare a slot"),
    Feature("all_lack_power", "share of the devices", "devices without power"),
    Feature("all_lack_comms", "share of the devices", "devices without communication"),
    Feature("devices", "log2, divided by 6", "number of devices"),
)
"""The features of each device, in order; the last seven are the same for all devices of a scenario."""


@struct.dataclass
class Observation:
    """The full observation of one state.

    Attributes:
        features: ``[n, F]`` f32, see :data:`FEATURES`; zero for padding.
        mask: ``[n]`` bool, which entries are devices and not padding (:func:`um.env.pad_layout`).
    """

    features: Float[Array, "*batch n F"]
    mask: Bool[Array, "*batch n"]


def observe_devices(params: Params, layout: Layout, state: State) -> Observation:
    """Return the full observation of a state before the slot.

    Args:
        params: scenario parameters.
        layout: ``n`` devices, some of which may be padding.
        state: before the slot.

    Raises:
        ArgumentError: a parameter, or a value of the layout or the state, is out of range; one line.
    """
    check_scenario(params, layout)
    check_state(layout, state)
    n = layout.capacity.shape[0]
    mask = jnp.ones(n, bool) if layout.present is None else layout.present
    count = jnp.sum(mask).astype(jnp.float32)
    derived = _Derived.of(params, layout)
    slots, services = deadlines.feasible_horizon(params, layout, state, derived.mean, derived.visit_share)
    per_device = {
        **_battery_features(layout, state, derived, slots, services, count),
        **_age_features(params, layout, state, derived, count),
        **_visit_features(params, layout, state, derived, mask),
        **_after_visit_features(params, layout, state, derived, slots),
        "traffic_price": layout.failure_price(state.elapsed) / 8.0,
    }
    shared = _shared_features(params, layout, state, derived, slots, services, count)
    features = jnp.concatenate([_stack(per_device), jnp.broadcast_to(_stack(shared), (n, len(shared)))], axis=-1)
    chex.assert_shape(features, (n, len(FEATURES)))
    return Observation(features=jnp.where(mask[:, None], features, 0.0), mask=mask)


def _stack(features: dict[str, Array]) -> Float[Array, "*n F"]:
    """Stack features along a new last axis, in the order of :data:`FEATURES`."""
    names = [feature.name for feature in FEATURES if feature.name in features]
    return jnp.stack([jnp.asarray(features[name], jnp.float32) for name in names], axis=-1)


class _Derived(NamedTuple):
    """Quantities derived from the parameters and the layout alone.

    Attributes:
        mean: the expected slot.
        covers: see :func:`demand.coverage`.
        visit_share: see :func:`demand.visit_shares`.
        drain: J, see :func:`demand.idle_drain`.
        expiry: slots without service after which data have expired, at least 1.
        use: J, ``use[a, d]``: energy that device ``d`` is expected to use in a slot with the UAV above device ``a``.
    """

    mean: SlotCosts
    covers: Bool[Array, "n n"]
    visit_share: Float[Array, " n"]
    drain: Float[Array, " n"]
    expiry: Float[Array, ""]
    use: Float[Array, "n n"]

    @classmethod
    def of(cls, params: Params, layout: Layout) -> "_Derived":
        covers = demand.coverage(params, layout)
        mean = demand.mean_slot(params, layout)
        work = jnp.where(covers, mean.upload, mean.work)
        use = jnp.where(layout.has_power, 0.0, layout.standby_power * mean.duration[:, None] + work)
        return cls(
            mean=mean,
            covers=covers,
            # In steps of 2**-16 the sums of shares are exact, so they do not depend on the order of the devices.
            visit_share=jnp.floor(demand.visit_shares(layout, covers) * 65536.0) / 65536.0,
            drain=demand.idle_drain(layout, mean),
            # One value for all features: XLA divides by several copies of it with different last bits.
            expiry=jnp.maximum(slots_to_expiry(params), 1).astype(jnp.float32),
            use=use,
        )


def _battery_features(
    layout: Layout,
    state: State,
    derived: _Derived,
    slots: Float[Array, ""],
    services: Float[Array, " n"],
    count: Float[Array, ""],
) -> dict[str, Array]:
    """Return the features of the batteries and of the services they need to survive ``slots`` slots."""
    mean = derived.mean
    unpowered = lambda value, otherwise: jnp.where(layout.has_power, otherwise, value)  # noqa: E731
    visited = layout.standby_power * jnp.min(mean.duration) + mean.upload
    saving = jnp.maximum(mean.work - mean.upload, 0.0)
    missing = (slots * derived.drain - state.battery) / jnp.maximum(saving, 1e-3)
    empty_in = jnp.where(services > 0, state.battery / jnp.maximum(derived.drain, 1e-6), jnp.inf)
    return {
        "lacks_power": unpowered(1.0, 0.0),
        "life_unvisited": unpowered(_lifetime(state.battery, derived.drain), 2.0),
        "life_visited": unpowered(_lifetime(state.battery, visited), 2.0),
        "saving": unpowered(saving / jnp.maximum(derived.drain, 1e-3), 0.0),
        "services": services / slots,
        "missing": unpowered(jnp.clip(missing / 8.0, -2.0, 2.0), -2.0),
        "empties_rank": jnp.where(services > 0, _rank(empty_in) / count, 1.0),
    }


def _age_features(
    params: Params, layout: Layout, state: State, derived: _Derived, count: Float[Array, ""]
) -> dict[str, Array]:
    """Return the features of the data ages and of their deadlines."""
    disconnected, expiry = ~layout.has_comms, derived.expiry
    deadline = _deadlines(params, layout, state.age)
    load = demand.load_by_deadline(deadline, derived.visit_share)
    return {
        "lacks_comms": disconnected,
        "age": _counted_age(layout, state) / expiry,
        "due": jnp.where(disconnected, deadline / expiry, 2.0),
        "crowding": jnp.where(disconnected, jnp.clip((load - deadline) / expiry, -2.0, 2.0), -2.0),
        "due_rank": _rank(deadline) / count,
    }


def _visit_features(
    params: Params, layout: Layout, state: State, derived: _Derived, mask: Bool[Array, " n"]
) -> dict[str, Array]:
    """Return what a visit to each device costs and which devices it serves."""
    duration = derived.mean.duration
    t_fly = jnp.linalg.norm(layout.position - state.uav_position[0], axis=-1) / params.uav_speed_m_s
    base, extra = demand.flight_power(params)
    served = derived.covers & (~layout.has_power | ~layout.has_comms)
    oldest = jnp.max(jnp.where(derived.covers, _counted_age(layout, state), 0.0), axis=1)
    return {
        "flight": jnp.minimum(t_fly / jnp.maximum(duration, 1e-3), 2.0),
        "here": t_fly <= 0.0,
        "together": jnp.sum(served, axis=1) / 4.0,
        "oldest_served": oldest / derived.expiry,
        "slot_length": duration / jnp.maximum(jnp.max(jnp.where(mask, duration, 0.0)), 1e-3),
        "uav_use": jnp.minimum((base * duration + extra * t_fly) / jnp.maximum(state.uav_energy[0], 1.0), 1.0),
    }


def _after_visit_features(
    params: Params, layout: Layout, state: State, derived: _Derived, slots: Float[Array, ""]
) -> dict[str, Array]:
    """Return how many slots are to spare, and how tight the tightest deadline is, after a visit to each device."""
    battery = state.battery - derived.use
    age = jnp.where(derived.covers, 0, state.age + jnp.where(layout.has_comms, 0, 1))
    remaining = jnp.maximum(slots - 1.0, 1.0)
    saving = jnp.maximum(derived.mean.work - derived.mean.upload, 1e-3)
    missing = (remaining * derived.drain - battery) / saving
    services = jnp.where(layout.has_power, 0.0, jnp.maximum(missing, 0.0))
    age_visits, _ = demand.age_visits(params, layout, age, remaining)
    spare = remaining - order_independent_sum(jnp.maximum(services, age_visits) * derived.visit_share)
    deadline = _deadlines(params, layout, age)
    load = demand.load_by_deadline(deadline, derived.visit_share)
    crowding = jnp.max(jnp.where(deadline < demand.NEVER, load - deadline, _NO_CROWDING), axis=-1)
    return {
        "spare_after": jnp.clip(spare / 8.0, -2.0, 2.0),
        "crowding_after": jnp.clip(crowding / derived.expiry, -2.0, 2.0),
        "on_time_after": crowding <= 0.0,
    }


def _shared_features(
    params: Params,
    layout: Layout,
    state: State,
    derived: _Derived,
    slots: Float[Array, ""],
    services: Float[Array, " n"],
    count: Float[Array, ""],
) -> dict[str, Array]:
    """Return the features that are the same for all devices."""
    base, _ = demand.flight_power(params)
    uav_slots = state.uav_energy[0] / jnp.maximum(base * jnp.min(derived.mean.duration), 1e-3)
    age_visits, _ = demand.age_visits(params, layout, state.age, slots)
    needed = order_independent_sum(jnp.maximum(services, age_visits) * derived.visit_share)
    deadline = _deadlines(params, layout, state.age)
    falls_due = deadline <= slots
    load = demand.load_by_deadline(jnp.where(falls_due, deadline, demand.NEVER), derived.visit_share)
    return {
        "hoped": slots / _LIFETIME_SCALE,
        "uav_life": jnp.minimum(uav_slots / _LIFETIME_SCALE, 2.0),
        "spare": (slots - needed) / slots,
        "can_wait": jnp.all(~falls_due | (load + 1.0 <= deadline)),
        "all_lack_power": jnp.sum(~layout.has_power) / count,
        "all_lack_comms": jnp.sum(~layout.has_comms) / count,
        "devices": jnp.log2(count) / 6.0,
    }


def _lifetime(battery: Float[Array, " n"], use: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the lifetimes of batteries in J at a use in J per slot, scaled and at most 2."""
    return jnp.minimum(battery / jnp.maximum(use, 1e-3) / _LIFETIME_SCALE, 2.0)


def _counted_age(layout: Layout, state: State) -> Float[Array, " n"]:
    """Return the data ages in slots, 0 with communication."""
    return jnp.where(layout.has_comms, 0, state.age).astype(jnp.float32)


def _deadlines(params: Params, layout: Layout, age: Int[Array, "*B n"]) -> Float[Array, "*B n"]:
    """Return the slots until each device's data expire; :data:`demand.NEVER` with communication."""
    return jnp.where(layout.has_comms, demand.NEVER, slots_to_expiry(params) - age).astype(jnp.float32)


def _rank(value: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the number of entries that are smaller than each."""
    return jnp.sum(value[None, :] < value[:, None], axis=1).astype(jnp.float32)

"""The package's slot against the reference, over random fleets in random situations."""

from collections import Counter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.env.fleet_reference import CHARGE, SWAP, reference_reward_terms, reference_slot
from uavmec_jax.env import hardware
from uavmec_jax.env.dynamics import Cause, State, transition
from uavmec_jax.env.fleet import Depots, Fleet
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.padding import mask_absent
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import make_reward, reward_of

CLOSE = 1e-5
"""Comparisons closer than this may go either way in single precision; such slots are left out and counted."""

REWARD_TERMS = "AOMUS"


@jax.jit
def play(params, layout, state, action, volumes):
    after, outcome = transition(params, layout, state, action, volumes)
    rewards = [make_reward({term: 1.0}) for term in REWARD_TERMS]
    return after, outcome, [reward_of(one, layout, state, action, after, params) for one in rewards]


class Shape(NamedTuple):
    """What fixes a program: numbers of UAVs, depots and devices, and what ends an episode."""

    uavs: int
    depots: int
    devices: int
    end: str
    fleet: bool = True  # whether the layout describes the UAVs, or leaves them to the parameters


SHAPES = [
    Shape(1, 0, 5, "first_failure", fleet=False),
    Shape(3, 2, 6, "first_failure"),
    Shape(4, 3, 7, "horizon"),
]
ALL_SHAPES = [
    Shape(k, d, 4 + k, end) for k in (1, 2, 3, 4, 6) for d in range(4) for end in ("first_failure", "horizon")
]


def name(shape):
    return "-".join(map(str, shape[:4])) + ("" if shape.fleet else "-params")


def draw_params(rng, shape):
    return Params(
        n_devices=shape.devices,
        end=shape.end,
        uav_battery_j=float(rng.choice([1e5, 3e5, 1.6e6])),
        uav_signal_range_m=float(rng.uniform(40, 150)),
        bandwidth_hz=float(rng.choice([1e6, 20e6])),  # long uploads, so that it matters who gets them
        transmit_power_w=float(rng.choice([0.1, 2.0])),
        data_age_limit_slots=int(rng.choice([2, 4, 10])),
        slot_cap_s=float(rng.choice([200.0, 600.0])),
        uplink_rate_bit_s=float(rng.choice([500.0, np.inf])),
        flight_power_adds_to_hover=bool(rng.integers(2)),
        count_unfinished_slot=bool(rng.integers(2)),
        age_at_limit_fails=bool(rng.integers(2)),
        horizon_s=float(rng.choice([1_000.0, 3_000.0, 43_200.0])),
        end_share=float(rng.choice([0.3, 0.5, 1.0])),
    )


def floats(values):
    return np.asarray(values, np.float32)


def draw_layout(rng, shape):
    n, region = shape.devices, rng.choice([200.0, 600.0])
    kind, task = rng.integers(5, size=n), rng.integers(5, size=n)
    layout = Layout(
        position=floats(rng.uniform(0, region, (n, 2))),
        device_type=kind.astype(np.int32),
        task=task.astype(np.int32),
        capacity=floats(rng.uniform(50e3, 80e3, n)),
        has_power=rng.random(n) < 0.3,
        has_comms=rng.random(n) < 0.3,
        standby_power=hardware.STANDBY_POWER_W[kind],
        active_power=hardware.ACTIVE_POWER_W[task, kind],
        processing_rate=hardware.PROCESSING_RATE_BYTES_S[task, kind],
    )
    if shape.fleet:
        layout = mask_absent(jax.tree.map(jnp.asarray, layout), jnp.arange(n) < n - rng.integers(2))
        layout = layout.replace(priority=floats(rng.choice([1.0, 5.0], n)), fleet=draw_fleet(rng, shape.uavs, region))
    if shape.depots:
        layout = layout.replace(depots=draw_depots(rng, shape.depots, region))
    return jax.tree.map(np.asarray, layout)


def draw_fleet(rng, k, region):
    same = rng.random() < 0.2  # equal UAVs that start together meet ties
    some = lambda low, high: floats(np.full(k, rng.uniform(low, high)) if same else rng.uniform(low, high, k))  # noqa: E731
    return Fleet(
        speed_m_s=some(3, 15),
        flying_power_w=some(100, 250),
        hovering_power_w=some(50, 120),
        battery_j=floats(rng.choice([5e4, 1.5e5, 4e5], k)),
        signal_range_m=some(40, 150),
        start_m=floats(rng.uniform(0, region, (k, 2))),
        present=np.arange(k) < max(1, k - (rng.random() < 0.2)),
    )


def draw_depots(rng, d, region):
    position = floats(rng.uniform(0, region, (d, 2)))
    if d > 1 and rng.random() < 0.2:
        position[1] = position[0]
    return Depots(
        position=position,
        kind=rng.choice([SWAP, CHARGE], d).astype(np.int32),
        pads=floats(rng.choice([0, 1, 1, 2, np.inf], d)),
        packs=floats(rng.choice([0, 1, 2, np.inf], d)),
        power_w=floats(rng.choice([0, 100, 667], d)),
    )


def draw_state(rng, shape, params, layout):
    """Draw a state in the middle of an episode; under a horizon, some devices are dead and some data have expired."""
    k, n = shape.uavs, shape.devices
    horizon = shape.end == "horizon"
    expiry = params.data_age_limit_slots + (not params.age_at_limit_fails)
    dead = horizon & ~layout.has_power & (rng.random(n) < rng.choice([0.0, 0.2, 1.0], p=[0.6, 0.35, 0.05]))
    share = rng.uniform(0.005, rng.choice([0.1, 1.0]), n)
    age = rng.integers(0, expiry + 2 if horizon else expiry, n)
    where = layout.position if layout.present is None else layout.position[layout.present]
    if shape.depots:
        where = np.concatenate([layout.depots.position, where])
    at = np.where(rng.random(k) < 0.5, 0, rng.integers(len(where), size=k))  # many at the first depot, or in one place
    capacity = layout.fleet.battery_j if shape.fleet else np.full(k, params.uav_battery_j)
    padding = ~layout.fleet.present if shape.fleet else np.zeros(k, bool)
    lost = (at >= shape.depots) & (rng.random(k) < 0.15) & (horizon or k > 1)  # the paper's episode ends with its UAV
    return State(
        battery=floats(np.where(dead, 0.0, np.where(layout.has_power, 1.0, share) * layout.capacity)),
        age=np.where(layout.has_comms, 0, age).astype(np.int32),
        uav_position=floats(where[at]),
        uav_energy=floats(capacity * rng.choice([rng.uniform(0, 0.3), rng.uniform(0.3, 1), 1.0], k)),
        slot=np.int32(7),
        elapsed=np.float32(rng.uniform(0, 900)),
        grounded=padding | lost,
        failed_at=np.where(dead, 3, -1).astype(np.int32),
        packs=np.zeros(0, np.float32) if layout.depots is None else layout.depots.packs,
    )


def draw_action(rng, shape):
    """Draw a place for each UAV: mostly devices, often the place of another, sometimes one that does not exist."""
    n, k = shape.devices, shape.uavs
    action = np.where(rng.random(k) < 0.7, rng.integers(n, size=k), rng.integers(n + shape.depots, size=k))
    action = np.where(rng.random(k) < 0.3, action[0], action)
    return np.where(rng.random(k) < 0.03, rng.choice([-3, 99]), action).astype(np.int32)


def compare(params, layout, state, action, volumes):
    """Play one slot in both ways; return the package's state, the reference's outcome and whether the slot was left out."""
    after, outcome, terms = jax.device_get(play(params, layout, state, action, volumes))
    expected, reference = reference_slot(params, layout, state, action, volumes)
    if reference["edge"] < CLOSE:
        return after, reference, True
    for field in ("cause", "failed", "served"):
        assert_array_equal(getattr(outcome, field), reference[field], err_msg=field)
    assert_allclose(outcome.first_failure, reference["first_failure"], rtol=1e-6)
    assert_allclose(outcome.duration, reference["duration"], rtol=1e-5)
    for field in ("slot", "age", "failed_at", "grounded", "packs", "uav_position"):
        assert_array_equal(getattr(after, field), expected[field], err_msg=field)
    assert_allclose(after.elapsed, expected["elapsed"], rtol=1e-5)
    within(after.battery, expected["battery"], state.battery, reference["drain"])
    charged = expected["uav_energy"] - (np.asarray(state.uav_energy) - reference["paid"])
    within(after.uav_energy, expected["uav_energy"], state.uav_energy, reference["paid"] + charged)
    wanted = reference_reward_terms(params, layout, state, action, after)
    assert_allclose(terms, [wanted[term] for term in REWARD_TERMS], rtol=1e-5, atol=1e-6)
    return after, reference, False


def within(value, expected, before, change):
    """Check an energy: a few roundings of what there was, and a relative error of what was taken or added."""
    difference = np.abs(value - expected)
    assert np.all(difference <= 3 * np.spacing(floats(before)) + CLOSE * np.asarray(change)), (value, expected)


def play_episodes(shape, episodes, seed=0):
    """Compare whole episodes, and count what happened in them."""
    rng = np.random.default_rng([seed, *shape[:3], shape.end == "horizon", shape.fleet])
    seen = Counter()
    for _ in range(episodes):
        params, layout = draw_params(rng, shape), draw_layout(rng, shape)
        state = draw_state(rng, shape, params, layout)
        for _ in range(8):
            action, volumes = draw_action(rng, shape), floats(rng.uniform(2e6, 4e6, shape.devices))
            after, outcome, left_out = compare(params, layout, state, action, volumes)
            seen.update(events(state, after, outcome, left_out))
            if outcome["cause"] != Cause.NONE:
                break
            state = after
    return seen


def events(before, after, outcome, left_out):
    taken_out = ~before.grounded & ~outcome["started"]
    happened = {
        "slots": True,
        "left out": left_out,
        Cause(outcome["cause"]).name: True,
        "grounded": np.any(after.grounded & ~before.grounded),
        "starts without a neighbour": np.any(taken_out) and np.any(outcome["started"]),
        "waits at a depot": outcome["duration"] > 0 and np.any(taken_out & ~after.grounded),
        "gets energy": np.any(after.uav_energy > before.uav_energy),
        "takes a pack": np.any(after.packs < before.packs),
        "dies": np.any((before.failed_at < 0) & (after.failed_at >= 0)),
        "is dead": np.any(before.failed_at >= 0),
    }
    return {event: int(whether) for event, whether in happened.items()}


def expected_events(shape):
    """Return what a fair sample of a shape's slots has met."""
    yield "dies"
    if shape.end == "first_failure":
        yield from ("BATTERY", "DATA_AGE", "UAV")
    else:
        yield from ("HORIZON", "SHARE", "grounded", "is dead")
    if shape.depots:
        yield from ("waits at a depot", "gets energy", "takes a pack")
    if shape.uavs > 1:
        yield from ("grounded", "starts without a neighbour")


def check(shape, episodes, seed=0):
    seen = play_episodes(shape, episodes, seed)
    assert [event for event in expected_events(shape) if not seen[event]] == [], seen
    assert seen["left out"] <= 0.02 * seen["slots"], seen


@pytest.mark.parametrize("shape", SHAPES, ids=name)
def test_the_slot_is_that_of_the_reference(shape):
    check(shape, episodes=100)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ALL_SHAPES, ids=name)
def test_the_slot_is_that_of_the_reference_in_every_shape(shape):
    check(shape, episodes=400, seed=1)

"""Small random instances with two UAVs or so, with and without a depot, that can be solved exactly."""

import functools
from typing import NamedTuple

import jax
import numpy as np

from tests.planning.exact import exact_tour
from tests.planning.instances import traced
from uavmec_jax.env.fleet import make_depots, make_fleet
from uavmec_jax.env.layout import Layout, sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import volume_table
from uavmec_jax.planning.beam import Tour

SLOTS = 64

MAX_SLOTS = 12
"""Longest lifetime: longer ones take too long to find."""


def fleet_instance(seed: int, *, uavs: int = 2, devices: int | None = None, max_slots: int = MAX_SLOTS):
    """Return parameters, layout, volume key and volume table of an instance with 3 or 4 devices and a short lifetime.

    A third of the instances has no depot; in a third, one UAV has a tenth of the other's battery. Speeds, ranges and powers
    differ between the UAVs now and then. Depots swap or charge, for both UAVs at once or for one, with or without an end.
    """
    rng = np.random.default_rng(seed)
    drawn = int(rng.integers(3, 5))
    n = devices or drawn
    side = float(rng.choice([150.0, 300.0, 800.0]))
    low, energy = float(rng.uniform(2.5e3, 7e3)), float(rng.uniform(1e5, 4e5))
    other = rng.random(3) < 0.3
    params = Params(
        n_devices=n,
        region_m=(side, side),
        data_age_limit_slots=int(rng.integers(1, 4)),
        device_battery_range_j=(low, 1.6 * low),
        uav_battery_j=energy,
        flight_power_adds_to_hover=bool(other[0]),
        age_at_limit_fails=bool(other[1]),
        count_unfinished_slot=bool(other[2]),
        uav_speed_m_s=float(rng.choice([1.0, 5.0, 5.0, 5.0])),
        uav_flying_power_w=float(rng.choice([40.0, 150.0])),
        max_slots=max_slots,
    )
    depots = None
    if rng.random() < 2 / 3:
        depots = make_depots(
            rng.uniform(0.0, side, (1, 2)),
            kind=str(rng.choice(["swap", "charge"])),
            pads=float(rng.choice([1.0, np.inf])),
            packs=float(rng.choice([0.0, 1.0, 2.0, np.inf])),
            power_w=float(rng.choice([100.0, 667.0])),
        )
    unequal = {
        "battery_j": [energy, 0.1 * energy, 0.5 * energy],
        "speed_m_s": [5.0, 1.0, 2.0],
        "signal_range_m": [65.0, 110.0, 65.0],
        "hovering_power_w": [80.0, 120.0, 100.0],
    }
    chosen = rng.random(4) < [1 / 3, 0.2, 0.2, 0.2]
    own = {name: values[:uavs] for (name, values), is_own in zip(unequal.items(), chosen, strict=True) if is_own}
    fleet = make_fleet(params, uavs, depots, **own)
    layout = sample_layout(jax.random.key(seed), params, int(rng.integers(0, n - 1)), int(rng.integers(0, n)))
    layout = layout.replace(fleet=fleet, depots=depots)
    key = jax.random.key(1000 + seed)
    return params, layout, key, volume_table(params, n, key, SLOTS)


class Solved(NamedTuple):
    """An instance and the best of its tours; the parameters are arrays."""

    params: Params
    layout: Layout
    key: jax.Array
    volumes: jax.Array
    tour: Tour


@functools.cache
def solved_instance(seed: int) -> Solved | None:
    """Return an instance with its best tour; ``None`` if it takes too long to find: one of seven seeds."""
    params, layout, key, volumes = fleet_instance(seed)
    params = traced(params)
    try:
        tour = exact_tour(params, layout, np.asarray(volumes), max_states=5000)
    except ValueError:
        return None
    return Solved(params, layout, key, volumes, tour)

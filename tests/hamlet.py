"""A hamlet with two UAVs and a depot, and a plan for it that is made by hand: nothing is searched for."""

import tomllib
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from uavmec_jax.env.measures import measure
from uavmec_jax.env.rollout import rollouts, tour_policy, trace
from uavmec_jax.planning.changes import WhatIf
from uavmec_jax.planning.forecast import Forecast
from uavmec_jax.planning.plan import Plan
from uavmec_jax.planning.service_bound import service_bound
from uavmec_jax.scenarios.named_scenario import make_named_scenario

HAMLET = """
name = "hamlet"
region = [[9.0, 53.0], [9.006, 53.0], [9.006, 53.003], [9.003, 53.004], [9.0, 53.004]]
[params]
end = "horizon"
horizon_s = 3600.0
[[uav]]
name = "ada"
[[uav]]
name = "bob"
at = "mill"
battery_j = 60_000.0
[[depot]]
name = "yard"
lon = 9.001
lat = 53.001
pads = 1
packs = 2
[[device]]
name = "mill"
lon = 9.005
lat = 53.002
type = "Firefly"
task = "HAAR"
capacity_j = 9_000.0
priority = 2.0
[[device]]
name = "quay"
lon = 9.002
lat = 53.003
type = "Raspberry Pi 4B"
task = "DNN"
capacity_j = 70_000.0
comms = true
[[device]]
name = "tower"
lon = 9.004
lat = 53.0005
type = "NanoPC-T4"
task = "MMOD"
capacity_j = 40_000.0
power = true
"""
"""The mill draws 3 kJ in a slot even if it is served; bob hovers there for one slot and cannot pay for another."""

TOUR = [[1, 0], [1, 0], [3, 0], [3, 0], [2, 0], [2, 0], [3, 0], [3, 0]]
"""Places of ada and bob. The two slots at the tower are short: no device computes for long. The last ends at 3,642 s."""


@cache
def hamlet(end="horizon"):
    return make_named_scenario(tomllib.loads(HAMLET), "hamlet.toml", {"end": end})


@cache
def hamlet_plan(end="horizon"):
    """Return the plan in which both planners follow :data:`TOUR`."""
    scenario = hamlet(end)
    params, layout, draws = scenario.params, scenario.layout, scenario.draws(2)
    policy = tour_policy(jnp.array(TOUR, jnp.int32))
    slots = jax.jit(jax.vmap(lambda draw: trace(policy, params, layout, draw, len(TOUR))))(draws)
    episodes = jax.tree.map(np.asarray, jax.jit(lambda: rollouts(policy, params, layout, draws))())
    goes_on = end == "horizon"
    first = jax.tree.map(lambda leaf: np.asarray(leaf[0])[np.asarray(slots.played[0])], slots)
    lifetimes = {"oldest-first": episodes.length - 1, "rollout": episodes.length}
    share = None if episodes.service_s is None else episodes.service_s / 3600
    changes = [WhatIf(0, "repair power", 6.0, 2.5), WhatIf(1, "remove", 4.0, -1.0)]
    if goes_on:
        changes = [WhatIf(0, "repair power", 6.0, 0.125, service=0.75), WhatIf(1, "remove", 6.0, -0.01, service=0.5)]
    return Plan(
        params=params,
        layout=jax.tree.map(np.asarray, layout),
        lifetimes=lifetimes if goes_on else lifetimes | {"beam": episodes.length + 1},
        bound=None if goes_on else episodes.length + 2,
        forecast=Forecast.of(episodes),
        tours={"rollout": first} if goes_on else {"rollout": first, "beam": first},
        what_if=tuple(changes),
        measures=jax.tree.map(
            np.asarray, jax.vmap(lambda slots: measure(params, layout, slots, by_time=goes_on))(slots)
        ),
        service={"oldest-first": share - 0.01, "rollout": share} if goes_on else None,
        service_bound=float(service_bound(params, layout)) if goes_on else None,
    )

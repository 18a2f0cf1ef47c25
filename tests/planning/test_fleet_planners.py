"""Rules, rollout planner and beam for fleets against the optimum of small instances, found by exhaustive search."""

from functools import partial

import jax
import numpy as np
import pytest

from tests.planning.fleet_instances import fleet_instance, solved_instance
from uavmec_jax.env.rollout import rollout, tour_policy
from uavmec_jax.planning.beam import beam_search
from uavmec_jax.planning.heuristics import FLEET_HEURISTICS
from uavmec_jax.planning.rollout_planner import rollout_planner

POLICIES = {**FLEET_HEURISTICS, "rollout planner": rollout_planner(samples=2)}

search = jax.jit(beam_search, static_argnames="width")


@partial(jax.jit, static_argnames="name")
def lifetime_of(name, params, layout, key):
    return rollout(POLICIES[name], params, layout, key).length


def check(seed):
    """Check that nothing beats the optimum and that a wide beam reaches it; return the optimum and the best of the others."""
    params, layout, key, volumes, optimum = solved_instance(seed)
    best = int(optimum.lifetime)
    lifetimes = {name: int(lifetime_of(name, params, layout, key)) for name in POLICIES}
    beams = {width: search(params, layout, volumes, width=width) for width in (1, 16, 2048)}
    lifetimes |= {f"beam {width}": int(tour.lifetime) for width, tour in beams.items()}
    assert max(lifetimes.values()) <= best, (seed, lifetimes)
    assert beams[2048].lifetime == best, (seed, lifetimes)
    assert beams[2048].bound >= best, seed
    for width, tour in beams.items():
        assert rollout(tour_policy(tour.actions), params, layout, key).length == tour.lifetime, (seed, width)
    return best, lifetimes


def of_one_shape(seed):
    """Return whether an instance has 3 devices and a depot: a planner is compiled once for all of these."""
    _, layout, *_ = fleet_instance(seed)
    return layout.depots is not None and layout.n_devices == 3


@pytest.mark.slow
@pytest.mark.parametrize("one_shape", [True, pytest.param(False, marks=pytest.mark.full)])
def test_no_policy_beats_the_optimum_and_a_wide_beam_reaches_it(one_shape):
    chosen = filter(of_one_shape, range(60)) if one_shape else range(30)
    seeds = [seed for seed in chosen if solved_instance(seed) is not None]
    assert len(seeds) >= 10
    shares = {}
    for seed in seeds:
        best, lifetimes = check(seed)
        for name, lifetime in lifetimes.items():
            shares.setdefault(name, []).append(lifetime / best)
    mean = {name: float(np.mean(of)) for name, of in shares.items()}
    assert mean["beam 16"] >= 0.98, mean
    assert mean["rollout planner"] >= 0.85, mean
    assert mean["stay-put"] < mean["earliest-deadline"] < mean["rollout planner"], mean

"""The upper bound: no policy, planner or exact optimum exceeds it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.planning.exact import exact_tour
from tests.planning.instances import SLOTS, small_instance, traced
from tests.small_scenarios import three_devices
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import rollout, volume_table
from uavmec_jax.planning.beam import beam_search
from uavmec_jax.planning.bound import upper_bound
from uavmec_jax.planning.fleet_demand import planned_slots
from uavmec_jax.planning.flight import Rounds
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.hover_sets import ListedHoverSets
from uavmec_jax.planning.parallel import beam_episodes, bound_scenarios, heuristic_episodes, rollout_planner_episodes
from uavmec_jax.planning.refutation import Refuter
from uavmec_jax.planning.requirements import Features, Rows
from uavmec_jax.planning.rollout_planner import rollout_planner
from uavmec_jax.scenarios.seeds import layout_for_seed

search = jax.jit(beam_search, static_argnums=3)


@functools.cache
def jitted_rollout(name):
    policy = rollout_planner(samples=1) if name == "rollout" else HEURISTICS[name]
    return jax.jit(functools.partial(rollout, policy))


@pytest.mark.slow
@pytest.mark.parametrize("first_seed", [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in (10, 20, 30))])
def test_nothing_exceeds_the_bound_on_small_instances(first_seed):
    """No policy exceeds the optimum, no optimum the bound, and a wide beam reaches the optimum."""
    for seed in range(first_seed, first_seed + 10):
        params, layout, key, volumes = small_instance(seed)
        params = traced(params)
        optimum = int(exact_tour(params, layout, np.asarray(volumes)).lifetime)
        assert optimum <= upper_bound(params, layout, volumes), seed
        beams = [int(search(params, layout, volumes, width).lifetime) for width in (1, 8, 512)]
        assert max(beams) <= optimum, seed
        assert beams[-1] == optimum, seed
        names = (*HEURISTICS, "rollout")
        lifetimes = {name: int(jitted_rollout(name)(params, layout, key).length) for name in names}
        assert max(lifetimes.values()) <= optimum, (seed, lifetimes)


@pytest.mark.slow
@pytest.mark.parametrize(("powered", "connected"), [(12, 4), (4, 4)])
def test_no_policy_exceeds_the_bound_at_the_papers_settings(powered, connected):
    params = traced(Params())
    for seed in range(2):
        layout, key = layout_for_seed(seed, params, powered, connected), jax.random.key(seed)
        volumes = volume_table(params, 12, key, SLOTS)
        bound = upper_bound(params, layout, volumes)
        names = ("earliest-deadline", "oldest-first")
        lifetimes = {name: int(jitted_rollout(name)(params, layout, key).length) for name in names}
        lifetimes["beam 64"] = int(search(params, layout, volumes, 64).lifetime)
        assert max(lifetimes.values()) <= bound, lifetimes
        assert bound - lifetimes["beam 64"] <= 2
        # Started from a lifetime that was reached, the search ends at the same place.
        assert upper_bound(params, layout, volumes, reached=lifetimes["beam 64"]) == bound


@pytest.mark.slow
@pytest.mark.parametrize(
    "side", [pytest.param(150.0, marks=pytest.mark.full), 300.0, pytest.param(800.0, marks=pytest.mark.full)]
)
def test_no_policy_exceeds_the_bound_on_many_layouts(side):
    """The regions range from crowded, where most devices share hover points, to the paper's."""
    count = 32
    params = jax.tree.map(lambda leaf: jnp.full(count, leaf), Params(region_m=(side, side)))
    counts = np.random.default_rng(int(side)).integers(0, 13, (2, count))
    layouts = jax.vmap(layout_for_seed)(jnp.arange(count), params, *jnp.asarray(counts))
    keys = jax.random.split(jax.random.key(int(side)), count)
    slots = planned_slots(params, layouts)
    episodes = heuristic_episodes(tuple(HEURISTICS), params, layouts, keys[:, None])
    lifetimes = dict(zip(HEURISTICS, episodes.length[:, :, 0], strict=True))
    lifetimes["rollout"] = rollout_planner_episodes(params, layouts, keys, slots=slots, samples=2)[1].length
    lifetimes |= {f"beam {w}": beam_episodes(params, layouts, keys, slots=slots, width=w)[1].length for w in (2, 64)}
    bound = bound_scenarios(params, layouts, keys, np.ones(count), slots=slots)
    for name, lifetime in lifetimes.items():
        assert (np.asarray(lifetime) <= bound).all(), name


def test_bounds_that_are_known_in_closed_form():
    params = traced(Params())
    intact = layout_for_seed(0, params, 12, 12)
    volumes = volume_table(params, 12, jax.random.key(0), SLOTS)
    assert upper_bound(params, intact, volumes) == int(search(params, intact, volumes, 64).lifetime) >= 33
    far = jnp.stack([200.0 * jnp.arange(12) % 800, 250.0 * (jnp.arange(12) // 4)], axis=1)
    damaged = layout_for_seed(0, params, 0, 0).replace(position=far)
    assert upper_bound(params, damaged, volumes) == 11
    assert int(search(params, damaged, volumes, 64).lifetime) == 11


def test_volumes_that_end_before_a_lifetime_may_are_refused():
    params = traced(Params())
    with pytest.raises(ValueError, match="volumes are given for 16 slots, and lifetimes may be longer"):
        upper_bound(params, layout_for_seed(3, params, 8, 8), volume_table(params, 12, jax.random.key(0), 16))


def test_no_lifetime_exceeds_the_horizon():
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], Params(n_devices=3))
    layout = three_devices(has_power=(True,) * 3, has_comms=(True,) * 3, processing_rate=jnp.full(3, 4e4))
    slots = planned_slots(params, jax.tree.map(lambda leaf: leaf[None], layout))
    lifetime = int(rollout(HEURISTICS["stay-put"], Params(n_devices=3), layout, jax.random.key(0)).length)
    assert 64 < lifetime <= slots == 512


def test_refutation_needs_multipliers_that_prove_it():
    # Two slots, two hover points: device 0 needs every slot at the first, device 1 some at the second.
    sets = ListedHoverSets(
        1, np.eye(2, dtype=bool), np.ones((2, 2)), *np.ones((2, 2, 2)), may_be_empty=False, may_decline=False
    )
    rows = Rows(features := Features(slots=2, devices=2, sizes=sets.sizes))
    slots = np.arange(2)
    rows.add(-1.0, (features.service(slots, np.zeros(2, int)), np.full(2, -1.0)))
    rows.add(-1.0, (features.service(slots, np.ones(2, int)), np.full(2, -1.0)))
    assert not Refuter(sets).refutes(rows.build(np.ones(2, int)))
    rows.add(-2.0, (features.service(slots, np.zeros(2, int)), np.full(2, -1.0)))
    assert Refuter(sets).refutes(rows.build(np.ones(2, int)))


def test_rounds_are_the_shortest_paths():
    position = np.array([[100.0, 0.0], [200.0, 0.0], [300.0, 0.0], [900.0, 900.0]])
    rounds = Rounds(position, np.eye(4, dtype=bool), np.array([True, True, True, False]), 11)
    assert_allclose(rounds.min_distance(10), 100.0)  # nothing falls due: the nearest device
    assert_allclose(rounds.min_distance(11), 300.0)
    assert_allclose(rounds.min_distance(21), 500.0)  # and back
    assert_allclose(rounds.min_distance(31), 700.0)
    covers = np.eye(4, dtype=bool)
    covers[1, :3] = True  # all are served from the middle
    shared = Rounds(position, covers, np.array([True, True, True, False]), 11)
    assert_allclose(shared.min_distance(31), 200.0)

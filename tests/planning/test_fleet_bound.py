"""The upper bound for fleets and depots: no tour exceeds it, and every tour meets all of its requirements."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.planning.fleet_instances import fleet_instance, solved_instance
from tests.planning.instances import SLOTS, traced
from uavmec_jax.env.fleet import make_depots, make_fleet
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import rollout, tour_policy, trace, volume_table
from uavmec_jax.planning import bound_instance
from uavmec_jax.planning.bound import _Bound, upper_bound
from uavmec_jax.planning.bound_instance import Instance, instances
from uavmec_jax.planning.energy_rows import _refills, endurance
from uavmec_jax.planning.fleet_demand import planned_slots
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.hover_sets import Columns, HoverSets
from uavmec_jax.planning.refutation import Refuter
from uavmec_jax.scenarios.seeds import layout_for_seed

PARAMS = Params(max_slots=SLOTS)


def instance_of(params, layout, volumes) -> Instance:
    return next(instances(*jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (params, layout, volumes))))


def town(seed, powered, connected, *, uavs, depots=None, **values):
    """Return a random layout at the paper's settings, but for the fleet, and its volumes."""
    layout = layout_for_seed(seed, PARAMS, powered, connected)
    layout = layout.replace(fleet=make_fleet(PARAMS, uavs, depots, **values), depots=depots)
    return layout, volume_table(PARAMS, 12, jax.random.key(seed), SLOTS)


class Played(HoverSets):
    """The hover sets of a tour, one in each slot.

    Args:
        instance: the scenario.
        hovers: ``[T, n]``, whether a UAV hovers above each device.
    """

    def __init__(self, instance: Instance, hovers):
        bits, t_work = instance.bits[: len(hovers)], instance.t_work[: len(hovers)]
        points = [np.flatnonzero(above) for above in hovers]
        served = np.array([instance.covers[above].any(axis=0) for above in points])
        reached = np.where(instance.covers, instance.rate, 1e-9)
        t_upload = bits / np.array([reached[above].max(axis=0, initial=1e-9) for above in points])
        t_served = np.minimum(t_upload, t_work) if instance.ranges_differ else t_upload
        duration = np.where(served, t_served, t_work).max(axis=1)
        self._columns = Columns(np.arange(len(hovers)), hovers.sum(axis=1), duration, served.astype(float))

    def cheapest(self, prices, largest):
        slot, size, duration, served = self._columns
        assert (size <= largest).all()
        costs = prices.by_second[slot, size] * duration + prices.by_use[slot, size]
        return costs - np.sum(prices.by_service * served, axis=1), self._columns


@jax.jit
def play(params, layout, key, tours):
    """Return of each tour the lifetime, and whether a UAV hovers above each device in each slot."""

    def play_one(tour):
        slots = trace(tour_policy(tour), params, layout, key, tour.shape[0])
        target = slots.action.reshape(tour.shape[0], -1)
        arrived = jnp.all(slots.state.uav_position == layout.places()[target], axis=-1)
        hovers = (target[..., None] == jnp.arange(layout.n_devices)) & (arrived & ~slots.state.grounded)[..., None]
        return slots.state.slot[-1], jnp.any(hovers, axis=1)

    return jax.vmap(play_one)(tours)


def check_requirements(params, layout, key, volumes, tours):
    """Check that the hover sets of tours meet the requirements of their lifetimes, and return the lifetimes."""
    instance = instance_of(params, layout, volumes)
    bound = _Bound(instance)
    lifetimes, hovers = (np.asarray(leaf) for leaf in play(params, layout, key, jnp.asarray(tours)))
    for lifetime, above in zip(lifetimes.tolist(), hovers, strict=True):
        if lifetime > 1:
            requirements = bound._requirements(lifetime)
            assert requirements is not None
            played = Played(instance, above[: len(requirements.largest)])
            assert not Refuter(played).refutes(requirements)
    return lifetimes


@pytest.mark.slow
@pytest.mark.parametrize("uavs", [pytest.param(1, marks=pytest.mark.full), 2, pytest.param(3, marks=pytest.mark.full)])
def test_tours_meet_the_requirements(uavs):
    longest = []
    for seed in range(20):
        params, layout, key, volumes = fleet_instance(seed, uavs=uavs)
        rng = np.random.default_rng(seed)
        tours = rng.integers(0, layout.n_places, (32, SLOTS, *layout.action_shape), np.int32)
        # Half of the tours stay at each place for a while.
        tours[16:] = np.repeat(tours[16:, : SLOTS // 4], 4, axis=1)
        longest.append(check_requirements(traced(params), layout, key, volumes, tours).max())
    assert np.mean(longest) > 4


@pytest.mark.slow
@pytest.mark.parametrize("first_seed", [0, pytest.param(15, marks=pytest.mark.full)])
def test_no_optimum_exceeds_the_bound(first_seed):
    """Nor does it break a requirement, and in most instances it is the bound."""
    gaps = []
    for seed in range(first_seed, first_seed + 15):
        if (solved := solved_instance(seed)) is None:
            continue
        *instance, tour = solved
        params, layout, _, volumes = instance
        bound = upper_bound(params, layout, volumes)
        assert tour.lifetime <= bound, seed
        assert upper_bound(params, layout, volumes, reached=int(tour.lifetime)) == bound, seed
        assert check_requirements(*instance, tour.actions[None]) == [tour.lifetime], seed
        gaps.append(bound - int(tour.lifetime))
    assert len(gaps) >= 10
    assert np.mean(np.array(gaps) == 0) >= 0.6


@pytest.mark.parametrize("seed", [pytest.param(15, marks=pytest.mark.slow), 82])
def test_the_optimum_of_two_small_instances_is_the_bound(seed):
    """A swap depot with one pad; no depot, and a UAV with a tenth of the other's battery."""
    *instance, tour = solved_instance(seed)
    params, layout, _, volumes = instance
    assert check_requirements(*instance, tour.actions[None]) == [tour.lifetime]
    assert upper_bound(params, layout, volumes) == tour.lifetime < params.max_slots


@pytest.mark.slow
def test_a_uav_that_is_grounded_early_refutes_nothing():
    """Intact networks live as long as the better battery lasts, and one slot of two UAVs costs more than the other has."""
    layout, volumes = town(0, 12, 12, uavs=2, battery_j=[1.6e6, 0.16e6])
    key = jax.random.key(0)
    lifetime = int(rollout(HEURISTICS["stay-put"], PARAMS, layout, key).length)
    params = traced(PARAMS)
    alone = upper_bound(params, layout.replace(fleet=None), volumes)
    assert 33 <= lifetime <= alone <= upper_bound(params, layout, volumes) <= alone + 1


@pytest.mark.parametrize("kind", ["swap", pytest.param("charge", marks=pytest.mark.slow)])
def test_depots_never_shorten_a_bound(kind):
    params, at_origin = traced(PARAMS), [[0.0, 0.0]]
    for uavs in (1, 2):
        without = upper_bound(params, *town(5, 8, 8, uavs=uavs))
        depots = make_depots(at_origin, kind)
        useless = depots.replace(packs=jnp.zeros(1), power_w=jnp.zeros(1))
        bounds = [upper_bound(params, *town(5, 8, 8, uavs=uavs, depots=each)) for each in (useless, depots)]
        assert without <= bounds[0] <= bounds[1]
        assert without < bounds[1]


def test_energy_limits_no_lifetime_where_there_are_depots():
    params = traced(PARAMS)
    layout, volumes = town(0, 12, 12, uavs=2, depots=make_depots([[0.0, 0.0]], packs=0.0))
    assert upper_bound(params, layout, volumes) == SLOTS
    stacked = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (params, layout))
    assert planned_slots(*stacked) == SLOTS
    assert planned_slots(stacked[0].replace(max_slots=jnp.array([1000])), stacked[1]) == 1024


def test_a_fleet_of_one_is_the_uav_of_the_parameters():
    params = traced(PARAMS)
    layout, volumes = town(3, 8, 4, uavs=1)
    assert upper_bound(params, layout, volumes) == upper_bound(params, layout.replace(fleet=None), volumes)
    present = jnp.array([True, False, False])
    padded = layout.replace(fleet=make_fleet(PARAMS, 3).replace(present=present))
    assert upper_bound(params, padded, volumes) == upper_bound(params, layout, volumes)


def test_sets_that_are_not_listed_loosen_the_bound(monkeypatch):
    params, depots = traced(PARAMS), make_depots([[0.0, 0.0]])
    towns = [town(seed, 4, 4, uavs=2, depots=depots) for seed in range(3)]
    listed = [upper_bound(params, *scenario) for scenario in towns]
    monkeypatch.setattr(bound_instance, "MAX_LISTED", 10)
    loose = [upper_bound(params, *scenario) for scenario in towns]
    assert all(low <= high <= low + 3 for low, high in zip(listed, loose, strict=True))


def test_what_depots_give():
    """Two UAVs hover 20,000 s each with full batteries."""
    landed = np.array([2, 1, 0])

    def refills(**values):
        depots = make_depots([[0.0, 0.0]], **values)
        instance = instance_of(traced(PARAMS), *town(0, 8, 8, uavs=2, depots=depots))
        everything, charged, packs = _refills(instance, instance.depots, endurance(instance, np.zeros(2)), landed)
        return everything[0], charged[0], packs

    swapped, charged, packs = refills()
    assert_allclose(swapped, [40_000.0, 20_000.0, 0.0], rtol=1e-4)
    assert_allclose(charged, 0.0)
    assert packs == np.inf
    assert_allclose(refills(pads=1.0, packs=3.0)[0], [20_000.0, 20_000.0, 0.0], rtol=1e-4)
    assert refills(packs=3.5)[2] == 3.0
    # A slot lasts 600 s at most: the longest way through the region takes 226 s.
    everything, charged, packs = refills(kind="charge", power_w=800.0)
    assert_allclose(everything, charged)
    assert_allclose(everything / everything[1], [2.0, 1.0, 0.0])
    assert everything[1] <= 6_000.0 * (1 + 1e-4)
    assert packs == 0.0


def test_bounds_are_for_the_first_failure():
    layout, volumes = town(0, 8, 8, uavs=2)
    with pytest.raises(ValueError, match="end is 'horizon'; upper bounds on lifetimes are for 'first_failure'"):
        upper_bound(traced(PARAMS).replace(end="horizon"), layout, volumes)

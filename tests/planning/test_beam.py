"""Beam search: its tours are feasible, its pruning is sound, and it finds shared hover points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.planning.instances import SLOTS, traced
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import rollout, tour_policy, volume_table
from uavmec_jax.planning import demand
from uavmec_jax.planning.beam import beam_search
from uavmec_jax.planning.beam_score import dominated
from uavmec_jax.scenarios.seeds import layout_for_seed

search = jax.jit(beam_search, static_argnums=3)
PARAMS = traced(Params())


def layout_with_a_pair():
    """Return a layout without any power or communication in which devices 0 and 1 can be served together."""
    layout = layout_for_seed(0, PARAMS, 0, 0)
    position = jnp.stack([200.0 * (jnp.arange(12) % 4), 300.0 * (jnp.arange(12) // 4)], axis=1)
    return layout.replace(position=position.at[1].set(position[0] + 40.0), capacity=jnp.full(12, 79_000.0))


@pytest.mark.parametrize(("powered", "connected", "seed"), [pytest.param(8, 8, 3, marks=pytest.mark.slow), (4, 4, 14)])
def test_the_tour_reaches_its_lifetime(powered, connected, seed):
    layout, key = layout_for_seed(seed, PARAMS, powered, connected), jax.random.key(seed)
    tour = search(PARAMS, layout, volume_table(PARAMS, 12, key, SLOTS), 64)
    episode = rollout(tour_policy(tour.actions), PARAMS, layout, key)
    assert episode.length == tour.lifetime <= tour.bound
    visits = np.asarray(tour.actions)
    assert (visits[: int(tour.lifetime)] >= 0).all()
    assert (visits[int(tour.lifetime) :] == -1).all()


def test_a_shared_hover_point_lets_the_network_outlive_eleven_slots():
    layout = layout_with_a_pair()
    tour = search(PARAMS, layout, volume_table(PARAMS, 12, jax.random.key(0), SLOTS), 64)
    assert tour.lifetime > 11


def test_the_search_starts_from_a_known_upper_bound():
    layout = layout_for_seed(3, PARAMS, 8, 8)
    volumes = volume_table(PARAMS, 12, jax.random.key(0), SLOTS)
    bounded_search = jax.jit(lambda bound: beam_search(PARAMS, layout, volumes, 16, upper_bound=bound))
    loose, tight = bounded_search(99), bounded_search(15)
    assert tight.bound == 15
    assert tight.lifetime == 15 < loose.lifetime


def test_volumes_of_another_number_of_devices_are_refused():
    layout = layout_for_seed(3, PARAMS, 8, 8)
    with pytest.raises(ValueError, match="shape"):
        beam_search(PARAMS, layout, jnp.zeros((SLOTS, 11)))


def test_dominance():
    layout = layout_for_seed(0, PARAMS, 0, 0)
    start = initial_state(PARAMS, layout)
    states = jax.tree.map(lambda leaf: jnp.stack([leaf] * 5), start)
    states = states.replace(
        age=states.age.at[1, 0].set(1),  # older data than 0
        battery=states.battery.at[2, 3].add(-1.0),  # less battery than 0
        uav_energy=states.uav_energy.at[3, 0].add(1.0),  # more energy than 0, but at another hover point
    )
    hover_point, alive = jnp.array([5, 5, 5, 6, 5]), jnp.ones(5, bool)
    assert dominated(layout, states, hover_point, alive).tolist() == [False, True, True, False, True]  # 4 is 0 again
    without_0 = dominated(layout, states, hover_point, alive.at[0].set(False))
    assert without_0[1:].tolist() == [True, True, False, False]  # 4 takes its place
    carefree = layout.replace(has_comms=jnp.ones(12, bool), has_power=jnp.ones(12, bool))
    assert dominated(carefree, states, hover_point, alive).tolist() == [False, True, True, False, True]


def test_visit_shares_of_a_hover_point_sum_to_at_most_one():
    for seed in range(8):
        params = Params(region_m=(150.0, 150.0))
        layout = layout_for_seed(seed, params, 6, 6)
        covers = demand.coverage(params, layout)
        share = demand.visit_shares(layout, covers)
        assert (covers @ share).max() <= 1 + 1e-6
        needy = ~(layout.has_power & layout.has_comms)
        assert ((share > 0) == needy).all()


def test_battery_visits_count_the_largest_savings_first():
    layout = layout_for_seed(0, PARAMS, 11, 12)
    volumes = volume_table(PARAMS, 12, jax.random.key(0), SLOTS)
    costs = jax.jit(demand.slot_costs)(PARAMS, layout, volumes)
    device = int(np.flatnonzero(~layout.has_power)[0])
    need = jax.jit(demand.battery_demand)(layout, costs, 0, 20)
    saving = np.sort(np.asarray(costs.work - costs.upload)[:20, device])[::-1]
    np.testing.assert_allclose(need.saved[:4, device], np.concatenate([[0.0], np.cumsum(saving[:3])]), rtol=1e-5)
    battery = jnp.full(12, need.drain[device] - saving[:2].sum() + 1.0)
    visits = jax.jit(demand.battery_visits)
    whole, fractional, infeasible = visits(layout, need, battery)
    assert whole[device] == 2
    assert 1 < fractional[device] <= 2
    assert whole.sum() == 2  # powered devices need none
    assert not infeasible.any()
    assert visits(layout, need, jnp.zeros(12))[2][device]


def test_mean_slot_is_the_mean_of_many():
    layout = layout_for_seed(1, PARAMS, 0, 0)
    many = jax.jit(demand.slot_costs)(PARAMS, layout, volume_table(PARAMS, 12, jax.random.key(0), 20_000))
    mean = jax.jit(demand.mean_slot)(PARAMS, layout)
    np.testing.assert_allclose(mean.work, many.work.mean(axis=0), rtol=0.01)

"""Exhaustive search against the enumeration of all tours."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.planning.exact import exact_tour, joint_actions
from tests.planning.fleet_instances import fleet_instance
from tests.planning.instances import SLOTS, small_instance, traced
from uavmec_jax.env.rollout import rollout, tour_policy

pytestmark = pytest.mark.slow

LENGTH = 7


def all_lifetimes(params, layout, key, length=LENGTH):
    """Return the lifetimes of all tours of ``length`` slots whose last action is then repeated."""
    actions = joint_actions(layout)
    tours = actions[np.array(list(itertools.product(range(len(actions)), repeat=length)))]
    tours = np.concatenate([tours, np.repeat(tours[:, -1:], SLOTS - length, axis=1)], axis=1)
    simulate = jax.jit(jax.vmap(lambda tour: rollout(tour_policy(tour), params, layout, key).length))
    return np.asarray(simulate(jnp.asarray(tours)))


@pytest.mark.parametrize("seed", [12, 15, 22])
def test_exact_is_the_best_of_all_tours(seed):
    params, layout, key, volumes = small_instance(seed, devices=3)
    params = params.replace(max_slots=LENGTH)  # no lifetime exceeds the length of the enumerated tours
    tour = exact_tour(traced(params), layout, np.asarray(volumes))
    lifetimes = all_lifetimes(params, layout, key)
    assert lifetimes.min() < lifetimes.max() <= LENGTH
    assert tour.lifetime == lifetimes.max()
    assert rollout(tour_policy(tour.actions), params, layout, key).length == tour.lifetime


@pytest.mark.parametrize("seed", [0, 6, 17, 21, 27, 42, 46, 48, 52])  # few of whose tours are the best
def test_exact_is_the_best_of_all_tours_of_a_fleet(seed):
    """Two UAVs and three places, two devices and a depot or three devices: 9 actions in each of 5 slots."""
    has_depot = fleet_instance(seed)[1].n_depots
    params, layout, key, volumes = fleet_instance(seed, devices=3 - has_depot, max_slots=5)
    tour = exact_tour(traced(params), layout, np.asarray(volumes))
    lifetimes = all_lifetimes(params, layout, key, length=5)
    assert lifetimes.min() < lifetimes.max() == tour.lifetime
    assert rollout(tour_policy(tour.actions), params, layout, key).length == tour.lifetime


def test_a_large_instance_is_refused():
    params, layout, _, volumes = small_instance(5, devices=5)
    with pytest.raises(ValueError, match="more than 2 states"):
        exact_tour(traced(params), layout, np.asarray(volumes), max_states=2)

"""The oracle itself, against every tour there is."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.planning.exact import exact_tour
from tests.planning.instances import SLOTS, small_instance, traced
from uavmec_jax.env.rollout import rollout, tour_policy

pytestmark = pytest.mark.slow

LENGTH = 7


def every_life(params, layout, key):
    """Lifetimes of all tours of :data:`LENGTH` slots that then stay where they are."""
    tours = np.array(list(itertools.product(range(3), repeat=LENGTH)), np.int32)
    tours = np.concatenate([tours, np.repeat(tours[:, -1:], SLOTS - LENGTH, axis=1)], axis=1)
    play = jax.jit(jax.vmap(lambda tour: rollout(tour_policy(tour), params, layout, key).length))
    return np.asarray(play(jnp.asarray(tours)))


@pytest.mark.parametrize("number", [12, 15, 22])
def test_exact_is_the_best_of_every_tour(number):
    params, layout, key, volumes = small_instance(number, devices=3)
    params = params.replace(max_slots=LENGTH)  # no life is longer than the tours enumerated
    found = exact_tour(traced(params), layout, np.asarray(volumes))
    lives = every_life(params, layout, key)
    assert lives.min() < lives.max() <= LENGTH
    assert found.lifetime == lives.max()
    assert rollout(tour_policy(jnp.asarray(found.actions)), params, layout, key).length == found.lifetime


def test_too_large_is_said():
    params, layout, _, volumes = small_instance(5, devices=5)
    with pytest.raises(ValueError, match="more than 2 states"):
        exact_tour(traced(params), layout, np.asarray(volumes), max_states=2)

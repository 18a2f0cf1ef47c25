"""The baselines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.worlds import three_devices
from uavmec_jax.planning.heuristics import HEURISTICS, oldest_first, random, round_robin, stay_put
from uavmec_jax.world.params import Params
from uavmec_jax.world.physics import initial_state

PARAMS, LAYOUT = Params(n_devices=3), three_devices()
START = initial_state(PARAMS, LAYOUT)


def test_oldest_first_takes_the_oldest_and_the_lowest_number_on_ties():
    assert oldest_first(PARAMS, LAYOUT, START.replace(age=jnp.array([1, 5, 2]))) == 1
    assert oldest_first(PARAMS, LAYOUT, START.replace(age=jnp.array([3, 5, 5]))) == 1
    assert oldest_first(PARAMS, LAYOUT, START) == 0


def test_round_robin_goes_round():
    visits = [int(round_robin(PARAMS, LAYOUT, START.replace(slot=jnp.int32(slot)))) for slot in range(7)]
    assert visits == [0, 1, 2, 0, 1, 2, 0]


def test_stay_put_stays():
    assert stay_put(PARAMS, LAYOUT, START.replace(age=jnp.array([1, 5, 2]))) == 0


def test_random_visits_everyone_evenly():
    visits = jax.vmap(lambda key: random(PARAMS, LAYOUT, START, key))(jax.random.split(jax.random.key(0), 3000))
    assert np.bincount(visits, minlength=3).min() > 900
    with pytest.raises(ValueError, match="needs a key"):
        random(PARAMS, LAYOUT, START)


@pytest.mark.parametrize("name", HEURISTICS)
def test_common_shape(name):
    policy = HEURISTICS[name]
    keys = jax.random.split(jax.random.key(0), 4)
    states = jax.vmap(lambda _: START)(keys)
    actions = jax.jit(jax.vmap(lambda state, key: policy(PARAMS, LAYOUT, state, key)))(states, keys)
    assert actions.shape == (4,)
    assert actions.dtype == jnp.int32

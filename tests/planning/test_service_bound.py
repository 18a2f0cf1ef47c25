"""The upper bound on the time in service: by hand, and against what policies reach."""

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

from tests.small_scenarios import three_devices
from uavmec_jax.env.fleet import make_depots, make_fleet
from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.padding import pad_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import rollouts
from uavmec_jax.planning.heuristics import FLEET_HEURISTICS
from uavmec_jax.planning.service_bound import service_bound

PARAMS = Params(n_devices=3, end="horizon", horizon_s=20_000.0)


def test_by_hand():
    # Batteries of 60 kJ last 30,000 s, 20,000 s and 15,000 s at 2 W, 3 W and 4 W in standby.
    assert_allclose(service_bound(PARAMS, three_devices()), (1 + 1 + 0.75) / 3, rtol=1e-5)
    powered = three_devices(has_power=(False, False, True))
    assert service_bound(PARAMS, powered) == 1
    weighted = three_devices(priority=jnp.array([0.0, 1.0, 3.0]))
    assert_allclose(service_bound(PARAMS, weighted), (1 + 3 * 0.75) / 4, rtol=1e-5)
    assert_allclose(service_bound(PARAMS, pad_layout(three_devices(), 5)), (1 + 1 + 0.75) / 3, rtol=1e-5)


def test_devices_that_draw_nothing_may_work_all_the_time():
    assert service_bound(PARAMS, three_devices(standby_power=jnp.zeros(3))) == 1


def test_a_batch():
    layouts = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), three_devices())
    bounds = jax.vmap(service_bound, (None, 0))(PARAMS, layouts)
    assert_allclose(bounds, [(1 + 1 + 0.75) / 3] * 2, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["earliest-deadline", "oldest-first", "stay-put"])
def test_no_policy_exceeds_it(name):
    """A swap depot in the middle lets two UAVs serve for hours; devices without work come close to the bound."""
    params = Params(n_devices=5, end="horizon", horizon_s=14_400.0, region_m=(150.0, 150.0), max_slots=2000)
    depots = make_depots([[75.0, 75.0]])

    @jax.jit
    @jax.vmap
    def both(key):
        layout = sample_layout(key, params, 2, 3)
        idle = jnp.where(jnp.arange(5) < 2, jnp.inf, layout.processing_rate)
        priority = jax.random.uniform(key, (5,))
        layout = layout.replace(
            processing_rate=idle, priority=priority, fleet=make_fleet(params, 2, depots), depots=depots
        )
        episodes = rollouts(FLEET_HEURISTICS[name], params, layout, jax.random.split(key, 2))
        return episodes.service_s / params.horizon_s, service_bound(params, layout)

    shares, bounds = both(jax.random.split(jax.random.key(0), 24))
    assert (shares <= bounds[:, None]).all()
    assert (shares > 0).all()
    if name == "oldest-first":
        assert (shares > 0.97 * bounds[:, None]).any()

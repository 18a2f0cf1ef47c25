"""Distributions of scenarios: what is drawn lies in its range, padding does no harm, typical scenarios are the paper's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from uavmec_jax.env import hardware as tables
from uavmec_jax.env.generator import ScenarioDistribution, sample_scenario, scenario_from_draw
from uavmec_jax.env.layout import pad_layout, sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import make_reward
from uavmec_jax.env.rollout import rollout, rollout_draws, rollouts
from uavmec_jax.env.scenario import make_scenario
from uavmec_jax.planning.heuristics import HEURISTICS

PARAMS = Params(n_devices=16)


def draw(count=400, **settings):
    distribution = ScenarioDistribution(PARAMS, make_reward({}, per_slot=0.1), **settings)
    sample = jax.jit(jax.vmap(lambda key: sample_scenario(distribution, key)))
    return sample(jax.random.split(jax.random.key(0), count))


def test_typical_scenarios_have_the_papers_numbers():
    drawn = draw(typical=1.0, traffic=0.0)
    layout, present = drawn.layout, np.asarray(drawn.layout.present)
    assert_array_equal(present.sum(1), 12)
    for has in (layout.has_power, layout.has_comms):
        counts = (np.asarray(has) & present).sum(1)
        assert counts.min() == 4
        assert counts.max() == 12
        assert len(np.unique(counts)) == 9
    capacity = np.asarray(layout.capacity)[present]
    assert 50_000 <= capacity.min() < 52_000 < 78_000 < capacity.max() <= 80_000
    assert np.asarray(layout.position)[present].max() <= 800
    standby = np.asarray(layout.standby_power)[present]
    assert set(np.unique(standby)) == set(tables.STANDBY_POWER_W)
    assert_allclose(drawn.params.uav_battery_j, 1.6e6)
    assert_array_equal(drawn.layout.traffic.price, 0)


@pytest.mark.slow
def test_other_scenarios_fill_their_ranges():
    drawn = draw(typical=0.0, traffic=1.0, traffic_weights=jnp.array([0.3, 1.0]))
    present = np.asarray(drawn.layout.present)
    assert set(present.sum(1)) == set(range(4, 17))
    for has in (drawn.layout.has_power, drawn.layout.has_comms):
        share = (np.asarray(has) & present).sum(1) / present.sum(1)
        assert share.min() == 0
        assert share.max() == 1
    side = np.asarray(drawn.params.region_m[0])
    assert 300 <= side.min() < 350 < 2200 < side.max() <= 2500
    assert (np.where(present[..., None], drawn.layout.position, 0).max((1, 2)) <= side).all()
    capacity = np.asarray(drawn.layout.capacity)[present]
    assert 25_000 <= capacity.min() < 30_000 < 130_000 < capacity.max() <= 160_000
    ratio = np.asarray(drawn.layout.standby_power) / tables.STANDBY_POWER_W[np.asarray(drawn.layout.device_type)]
    assert_allclose([ratio[present].min(), ratio[present].max()], [0.7, 1.4], rtol=0.02)
    price = np.asarray(drawn.layout.traffic.price)
    assert 0 <= price.min() < 1 < 19 < price.max() <= 20
    assert_allclose(drawn.reward.traffic_penalty, 0.1 * price, rtol=1e-6)
    assert np.isclose(np.asarray(drawn.layout.traffic.weight), 0.3).mean() > 0.15


_MORE = ("oldest-first", "earliest-deadline", "random", "lowest-battery")


@pytest.mark.bits
@pytest.mark.parametrize(
    "name", ["round-robin", "shortest-tour", *(pytest.param(name, marks=pytest.mark.slow) for name in _MORE)]
)
def test_rules_do_not_notice_padding(name):
    """A layout with entries that are no devices lives as long as without; random draws are others."""
    params = Params()
    layout = sample_layout(jax.random.key(4), params, 8, 8)
    padded = pad_layout(layout, 14)
    keys = jax.random.split(jax.random.key(1), 16)
    flat = params.replace(task_volume_range_bytes=(3e6, 3e6))  # volumes are drawn by place: equal ones do not tell
    short, long = (
        jax.jit(lambda one: rollouts(HEURISTICS[name], flat, one, keys).length)(one) for one in (layout, padded)
    )
    if name == "random":
        assert abs(short.mean() - long.mean()) < 1.5
    else:
        assert_array_equal(short, long)


def test_too_many_devices_are_not_padded():
    with pytest.raises(ValueError, match="has 12 devices; they do not fit into 8"):
        pad_layout(sample_layout(jax.random.key(0), Params(), 4, 4), 8)


@pytest.mark.slow
def test_draws_are_played_in_their_own_scenarios():
    distribution = ScenarioDistribution(PARAMS, make_reward({}))
    keys = jax.random.split(jax.random.key(3), 4)
    rule = HEURISTICS["oldest-first"]
    lives = jax.jit(lambda keys: rollout_draws(rule, distribution, keys).length)(keys)
    for key, life in zip(keys, lives, strict=True):
        one = scenario_from_draw(distribution, key)
        assert int(jax.jit(lambda one, key: rollout(rule, one.params, one.layout, key).length)(one, key)) == life
    fixed = make_scenario()
    assert_array_equal(rollout_draws(rule, fixed, keys).length, rollouts(rule, fixed.params, fixed.layout, keys).length)


@pytest.mark.slow
def test_the_reward_of_a_life_is_its_length():
    from uavmec_jax.env.rollout import returns

    scenario = make_scenario(reward=make_reward({}, per_slot=0.5))
    keys = jax.random.split(jax.random.key(3), 8)
    rule = HEURISTICS["earliest-deadline"]
    lives = jax.jit(lambda: rollouts(rule, scenario.params, scenario.layout, keys).length)()
    assert_allclose(jax.jit(lambda: returns(rule, scenario, keys))(), 0.5 * lives, rtol=1e-6)

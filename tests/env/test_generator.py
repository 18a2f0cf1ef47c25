"""Distributions of scenarios: draws lie in their ranges, padding changes nothing, typical scenarios are the paper's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from uavmec_jax.env import hardware
from uavmec_jax.env.drawn_rollouts import rollout_draws
from uavmec_jax.env.generator import ScenarioDistribution, sample_scenario, scenario_from_draw
from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.padding import pad_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import make_reward
from uavmec_jax.env.rollout import returns, rollout, rollouts
from uavmec_jax.env.scenario import make_scenario
from uavmec_jax.planning.heuristics import HEURISTICS

PARAMS = Params(n_devices=16)


def draw(count=400, **settings):
    distribution = ScenarioDistribution(PARAMS, make_reward({}, per_slot=0.1), **settings)
    sample = jax.jit(jax.vmap(lambda key: sample_scenario(distribution, key)))
    return sample(jax.random.split(jax.random.key(0), count))


def test_typical_scenarios_have_the_papers_numbers():
    scenarios = draw(typical=1.0, traffic=0.0)
    layout, present = scenarios.layout, np.asarray(scenarios.layout.present)
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
    assert set(np.unique(standby)) == set(hardware.STANDBY_POWER_W)
    assert_allclose(scenarios.params.uav_battery_j, 1.6e6)
    assert_array_equal(scenarios.layout.traffic.price, 0)


@pytest.mark.slow
def test_other_scenarios_fill_their_ranges():
    scenarios = draw(typical=0.0, traffic=1.0, traffic_weights=jnp.array([0.3, 1.0]))
    present = np.asarray(scenarios.layout.present)
    assert set(present.sum(1)) == set(range(4, 17))
    for has in (scenarios.layout.has_power, scenarios.layout.has_comms):
        share = (np.asarray(has) & present).sum(1) / present.sum(1)
        assert share.min() == 0
        assert share.max() == 1
    side = np.asarray(scenarios.params.region_m[0])
    assert 300 <= side.min() < 350 < 2200 < side.max() <= 2500
    assert (np.where(present[..., None], scenarios.layout.position, 0).max((1, 2)) <= side).all()
    capacity = np.asarray(scenarios.layout.capacity)[present]
    assert 25_000 <= capacity.min() < 30_000 < 130_000 < capacity.max() <= 160_000
    ratio = (
        np.asarray(scenarios.layout.standby_power) / hardware.STANDBY_POWER_W[np.asarray(scenarios.layout.device_type)]
    )
    assert_allclose([ratio[present].min(), ratio[present].max()], [0.7, 1.4], rtol=0.02)
    price = np.asarray(scenarios.layout.traffic.price)
    assert 0 <= price.min() < 1 < 19 < price.max() <= 20
    assert_allclose(scenarios.reward.traffic_penalty, 0.1 * price, rtol=1e-6)
    assert np.isclose(np.asarray(scenarios.layout.traffic.weight), 0.3).mean() > 0.15


_SLOW = ("oldest-first", "earliest-deadline", "random", "lowest-battery")


@pytest.mark.bits
@pytest.mark.parametrize(
    "name", ["round-robin", "shortest-tour", *(pytest.param(name, marks=pytest.mark.slow) for name in _SLOW)]
)
def test_padding_does_not_change_lifetimes(name):
    """A padded layout has the same lifetimes; only the random heuristic draws other numbers."""
    params = Params()
    layout = sample_layout(jax.random.key(4), params, 8, 8)
    padded = pad_layout(layout, 14)
    keys = jax.random.split(jax.random.key(1), 16)
    equal = params.replace(task_volume_range_bytes=(3e6, 3e6))  # the volumes drawn depend on the number of entries
    lengths, padded_lengths = (
        jax.jit(lambda layout: rollouts(HEURISTICS[name], equal, layout, keys).length)(layout)
        for layout in (layout, padded)
    )
    if name == "random":
        assert abs(lengths.mean() - padded_lengths.mean()) < 1.5
    else:
        assert_array_equal(lengths, padded_lengths)


def test_more_devices_than_entries_are_refused():
    with pytest.raises(ValueError, match="size is 8; the layout has 12 devices: give 12 or more"):
        pad_layout(sample_layout(jax.random.key(0), Params(), 4, 4), 8)


@pytest.mark.slow
def test_draws_are_played_in_their_own_scenarios():
    distribution = ScenarioDistribution(PARAMS, make_reward({}))
    keys = jax.random.split(jax.random.key(3), 4)
    policy = HEURISTICS["oldest-first"]
    lengths = jax.jit(lambda keys: rollout_draws(policy, distribution, keys).length)(keys)
    length_in = jax.jit(lambda scenario, key: rollout(policy, scenario.params, scenario.layout, key).length)
    for key, length in zip(keys, lengths, strict=True):
        assert length_in(scenario_from_draw(distribution, key), key) == length
    fixed = make_scenario()
    assert_array_equal(
        rollout_draws(policy, fixed, keys).length, rollouts(policy, fixed.params, fixed.layout, keys).length
    )


@pytest.mark.slow
def test_a_reward_per_slot_alone_is_proportional_to_the_lifetime():
    scenario = make_scenario(reward=make_reward({}, per_slot=0.5))
    keys = jax.random.split(jax.random.key(3), 8)
    policy = HEURISTICS["earliest-deadline"]
    lengths = jax.jit(lambda: rollouts(policy, scenario.params, scenario.layout, keys).length)()
    assert_allclose(jax.jit(lambda: returns(policy, scenario, keys))(), 0.5 * lengths, rtol=1e-6)

"""How agents that learn Q-values explore: epsilons, guides, and padding, which is never visited."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from tests.small_scenarios import mid_life
from uavmec_jax.agents.exploration import GUIDES, NO_GUIDE, exploratory_action, spread_epsilons
from uavmec_jax.env.padding import pad_layout
from uavmec_jax.env.rewards import make_reward
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.planning.heuristics import HEURISTICS

DRAWS = 6000


def padded_scenario(seed=3, n=5, entries=3):
    """Return a scenario and a state in which the last entries are not devices."""
    params, layout, state = mid_life(seed, n)
    battery = jnp.pad(state.battery, (0, entries), constant_values=1.0)
    state = replace(state, battery=battery, age=jnp.pad(state.age, (0, entries)))
    return Scenario(replace(params, n_devices=n + entries), pad_layout(layout, n + entries), make_reward()), state


def explore(scenario, state, guide, guidance):
    """Draw many exploratory actions."""
    uniform = jax.random.uniform(jax.random.key(0), (DRAWS, 2))
    draw = jax.jit(jax.vmap(lambda numbers: exploratory_action(scenario, state, guide, guidance, numbers)))
    return np.asarray(draw(uniform))


def test_epsilons_are_spread_geometrically():
    epsilons = np.asarray(spread_epsilons(0.4, 0.025, 5))
    assert_allclose(epsilons, [0.4, 0.2, 0.1, 0.05, 0.025], rtol=1e-6)
    assert_allclose(spread_epsilons(0.4, 0.1, 1), [0.2], rtol=1e-6)
    assert_allclose(spread_epsilons(0.3, 0.3, 4), [0.3] * 4, rtol=1e-6)


def test_without_guidance_every_device_is_as_likely():
    scenario, state = padded_scenario()
    for guide in (NO_GUIDE, "oldest-first"):
        counts = np.bincount(explore(scenario, state, guide, 0.0), minlength=8)
        assert not counts[5:].any()
        assert stats.chisquare(counts[:5]).pvalue > 1e-3


def test_the_last_random_number_draws_a_device():
    scenario, state = padded_scenario()
    for number, device in ((0.0, 0), (1.0 - 2.0**-24, 4)):
        assert exploratory_action(scenario, state, NO_GUIDE, 0.0, jnp.array([0.5, number])) == device


@pytest.mark.parametrize("guide", [guide for guide in GUIDES if guide != NO_GUIDE])
def test_full_guidance_is_the_heuristic(guide):
    for seed in range(3):
        scenario, state = padded_scenario(seed)
        expected = HEURISTICS[guide](scenario.params, scenario.layout, state)
        assert 0 <= expected < 5
        assert_array_equal(explore(scenario, state, guide, 1.0)[:100], expected)


def test_guidance_is_the_share_of_guided_actions():
    scenario, state = padded_scenario()
    guided = int(HEURISTICS["oldest-first"](scenario.params, scenario.layout, state))
    actions = explore(scenario, state, "oldest-first", 0.3)
    share = 0.3 + 0.7 / 5  # a random action may be the guide's, too
    assert stats.binomtest(int((actions == guided).sum()), DRAWS, share).pvalue > 1e-3
    others = np.delete(np.bincount(actions, minlength=8), guided)
    assert stats.chisquare(others[:4]).pvalue > 1e-3

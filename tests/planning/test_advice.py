"""Advice: the next visit, the life to expect, and who fails first, from many futures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.small_scenarios import mid_life
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.layout import Traffic
from uavmec_jax.env.rollout import rollouts
from uavmec_jax.planning.advice import advise
from uavmec_jax.planning.changes import CHANGES
from uavmec_jax.planning.heuristics import HEURISTICS

RULE = HEURISTICS["earliest-deadline"]
SAMPLES = 64


@pytest.fixture(scope="module")
def scene():
    return mid_life(5, 6)


@pytest.fixture(scope="module")
def advice(scene):
    params, layout, state = scene
    return advise(RULE, params, layout, state, samples=SAMPLES, what_if=True)


def test_the_best_candidate_comes_first(advice):
    lives = [one.lifetime for one in advice.candidates]
    assert advice.candidates[0].device == advice.chosen
    assert lives[1:] == sorted(lives[1:], reverse=True)
    assert lives[0] >= lives[1] - 1e-3
    assert {one.device for one in advice.candidates} == set(range(6))
    for one in advice.candidates:
        assert_allclose(one.behind, lives[0] - one.lifetime, atol=1e-5)
        assert one.behind_low <= one.behind <= one.behind_high


def test_probabilities_and_lifetimes_belong_together(advice):
    assert_allclose(advice.lifetimes.mean(), advice.candidates[0].lifetime, rtol=1e-6)
    assert len(advice.lifetimes) == SAMPLES
    low, high = advice.interval
    assert advice.lifetimes.min() <= low <= advice.lifetimes.mean() <= high <= advice.lifetimes.max()
    assert 0 <= advice.first_failure.sum() <= 1 + 1e-6
    assert_allclose(sum(advice.causes.values()), 1)
    fails = advice.first_failure > 0
    assert_array_equal(np.isfinite(advice.failure_slot), fails)
    assert (advice.failure_slot[fails] >= advice.lifetimes.min()).all()
    assert (advice.failure_slot[fails] <= advice.lifetimes.max()).all()


def test_lives_count_from_the_first_slot(scene, advice):
    assert advice.lifetimes.min() > int(scene[2].slot)


def test_what_a_repair_brings(scene, advice):
    _, layout, _ = scene
    lacks = np.sum(~np.asarray(layout.has_power)) + np.sum(~np.asarray(layout.has_comms))
    assert len(advice.what_if) == lacks + 6
    gains = [one.gain for one in advice.what_if]
    assert gains == sorted(gains, reverse=True)
    assert {one.change for one in advice.what_if} == set(CHANGES)


@pytest.mark.slow
def test_the_policys_own_choice_is_kept_where_nothing_is_better():
    """With power and communication everywhere no visit of a device that is near is better than another."""
    params, layout, _ = mid_life(0, 3)
    layout = layout.replace(has_power=jnp.ones(3, bool), has_comms=jnp.ones(3, bool), position=jnp.zeros((3, 2)))
    advice = advise(RULE, params, layout, samples=8)
    assert advice.chosen == advice.policy_choice
    assert advice.first_failure.sum() == 0


@pytest.mark.slow
def test_forecasts_are_those_of_independent_futures(scene):
    """Probabilities from other futures agree within what 4 standard errors allow."""
    params, layout, _ = scene
    advice = advise(RULE, params, layout, samples=256)
    first_this = int(advice.chosen)

    def policy(params, layout, state, key=None):
        return jnp.where(state.slot == 0, first_this, RULE(params, layout, state, key))

    keys = jax.random.split(jax.random.key(99), 256)
    played = jax.jit(lambda: rollouts(policy, params, layout, keys))()
    share = np.asarray(played.first_failure).mean(axis=0)
    assert np.abs(share - advice.first_failure).max() < 4 * np.sqrt(2 * 0.25 / 256)
    error = 4 * np.sqrt(2) * max(advice.lifetimes.std(), 0.5) / 16
    assert abs(np.asarray(played.length).mean() - advice.lifetimes.mean()) < error


@pytest.mark.slow
def test_same_key_same_advice(scene):
    params, layout, state = scene
    again = [advise(RULE, params, layout, state, key=jax.random.key(k), samples=32) for k in (3, 3, 4)]
    assert_array_equal(again[0].lifetimes, again[1].lifetimes)
    start = advise(RULE, params, layout, initial_state(params, layout), samples=32)
    assert_array_equal(start.lifetimes, advise(RULE, params, layout, samples=32).lifetimes)


@pytest.mark.slow
def test_a_price_is_part_of_what_a_visit_is_worth(scene):
    """Whoever must not fail first is worth a detour: the advice earns at least what it does without looking at the price."""
    params, layout, state = scene
    free = advise(RULE, params, layout, state, samples=SAMPLES)
    weight = jnp.asarray(free.first_failure, jnp.float32)[None]
    priced = layout.replace(traffic=Traffic(weight, jnp.float32(jnp.inf), jnp.float32(50.0)))
    spared = advise(RULE, params, priced, state, samples=SAMPLES)
    cost = 50.0 * np.asarray(weight[0])
    earned = [one.lifetimes.mean() - one.first_failure @ cost for one in (free, spared)]
    assert earned[1] >= earned[0] - 1e-3
    assert all(one.behind >= -1e-3 for one in spared.candidates)

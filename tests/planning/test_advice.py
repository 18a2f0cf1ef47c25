"""Advice: the next visit, the expected lifetime, and the first failure, from many futures."""

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

POLICY = HEURISTICS["earliest-deadline"]
SAMPLES = 64


@pytest.fixture(scope="module")
def scenario():
    return mid_life(5, 6)


@pytest.fixture(scope="module")
def advice(scenario):
    params, layout, state = scenario
    return advise(POLICY, params, layout, state, samples=SAMPLES, what_if=True)


def test_the_best_candidate_comes_first(advice):
    lifetimes = [candidate.lifetime for candidate in advice.candidates]
    assert advice.candidates[0].device == advice.device
    assert lifetimes[1:] == sorted(lifetimes[1:], reverse=True)
    assert lifetimes[0] >= lifetimes[1] - 1e-3
    assert {candidate.device for candidate in advice.candidates} == set(range(6))
    for candidate in advice.candidates:
        assert_allclose(candidate.behind, lifetimes[0] - candidate.lifetime, atol=1e-5)
        assert candidate.behind_low <= candidate.behind <= candidate.behind_high


def test_the_forecast_is_that_of_the_best_candidate(advice):
    forecast = advice.forecast
    assert_allclose(forecast.lifetimes.mean(), advice.candidates[0].lifetime, rtol=1e-6)
    assert len(forecast.lifetimes) == SAMPLES
    low, high = forecast.interval
    assert forecast.lifetimes.min() <= low <= forecast.lifetimes.mean() <= high <= forecast.lifetimes.max()
    assert 0 <= forecast.first_failure.sum() <= 1 + 1e-6
    assert_allclose(sum(forecast.causes.values()), 1)
    fails_first = forecast.first_failure > 0
    assert_array_equal(np.isfinite(forecast.failure_slot), fails_first)
    assert (forecast.failure_slot[fails_first] >= forecast.lifetimes.min()).all()
    assert (forecast.failure_slot[fails_first] <= forecast.lifetimes.max()).all()


def test_lifetimes_count_from_the_first_slot(scenario, advice):
    assert advice.forecast.lifetimes.min() > int(scenario[2].slot)


def test_every_repair_and_removal_is_tried(scenario, advice):
    _, layout, _ = scenario
    repairs = np.sum(~np.asarray(layout.has_power)) + np.sum(~np.asarray(layout.has_comms))
    assert len(advice.what_if) == repairs + 6
    gains = [entry.gain for entry in advice.what_if]
    assert gains == sorted(gains, reverse=True)
    assert {entry.change for entry in advice.what_if} == set(CHANGES)


@pytest.mark.slow
def test_the_policys_choice_is_kept_unless_another_is_better():
    """With power and communication everywhere, and all devices at one place, every visit is worth the same."""
    params, layout, _ = mid_life(0, 3)
    layout = layout.replace(has_power=jnp.ones(3, bool), has_comms=jnp.ones(3, bool), position=jnp.zeros((3, 2)))
    advice = advise(POLICY, params, layout, samples=8)
    assert advice.device == advice.policy_choice
    assert advice.forecast.first_failure.sum() == 0


@pytest.mark.slow
def test_the_forecast_agrees_with_independent_futures(scenario):
    """Probabilities from other futures agree within 4 standard errors."""
    params, layout, _ = scenario
    advice = advise(POLICY, params, layout, samples=256)
    forecast = advice.forecast

    def policy(params, layout, state, key=None):
        return jnp.where(state.slot == 0, advice.device, POLICY(params, layout, state, key))

    keys = jax.random.split(jax.random.key(99), 256)
    played = jax.jit(lambda: rollouts(policy, params, layout, keys))()
    share = np.asarray(played.first_failure).mean(axis=0)
    assert np.abs(share - forecast.first_failure).max() < 4 * np.sqrt(2 * 0.25 / 256)
    error = 4 * np.sqrt(2) * max(forecast.lifetimes.std(), 0.5) / 16
    assert abs(np.asarray(played.length).mean() - forecast.lifetimes.mean()) < error


@pytest.mark.slow
def test_same_key_same_advice(scenario):
    params, layout, state = scenario
    again = [advise(POLICY, params, layout, state, key=jax.random.key(k), samples=32) for k in (3, 3, 4)]
    assert_array_equal(again[0].forecast.lifetimes, again[1].forecast.lifetimes)
    start = advise(POLICY, params, layout, initial_state(params, layout), samples=32)
    assert_array_equal(start.forecast.lifetimes, advise(POLICY, params, layout, samples=32).forecast.lifetimes)


@pytest.mark.slow
def test_the_price_of_a_failure_counts(scenario):
    """Advice that knows the prices reaches at least the value of advice that ignores them."""
    params, layout, state = scenario
    unpriced = advise(POLICY, params, layout, state, samples=SAMPLES)
    weight = jnp.asarray(unpriced.forecast.first_failure, jnp.float32)[None]
    priced_layout = layout.replace(traffic=Traffic(weight, jnp.float32(jnp.inf), jnp.float32(50.0)))
    with_prices = advise(POLICY, params, priced_layout, state, samples=SAMPLES)
    cost = 50.0 * np.asarray(weight[0])
    value = [
        advice.forecast.lifetimes.mean() - advice.forecast.first_failure @ cost for advice in (unpriced, with_prices)
    ]
    assert value[1] >= value[0] - 1e-3
    assert all(candidate.behind >= -1e-3 for candidate in with_prices.candidates)

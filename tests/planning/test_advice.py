"""Advice: the next visit, its forecast, and what a repair brings."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.hamlet import hamlet
from tests.small_scenarios import mid_life
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.fleet import make_fleet
from uavmec_jax.env.layout import Traffic
from uavmec_jax.env.rollout import rollouts
from uavmec_jax.planning import advice as advice_module
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
    assert advice.place == advice.candidates[0].place
    assert lifetimes[1:] == sorted(lifetimes[1:], reverse=True)
    assert lifetimes[0] >= lifetimes[1] - 1e-3
    assert {candidate.place for candidate in advice.candidates} == set(range(6))
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
    fails = forecast.first_failure > 0
    assert_array_equal(np.isfinite(forecast.failure_slot), fails)
    assert (forecast.failure_slot[fails] >= forecast.lifetimes.min()).all()
    assert (forecast.failure_slot[fails] <= forecast.lifetimes.max()).all()


def test_lifetimes_count_from_the_first_slot(scenario, advice):
    assert advice.forecast.lifetimes.min() > int(scenario[2].slot)


def test_what_if_has_every_repair_and_removal(scenario, advice):
    _, layout, _ = scenario
    lacks = np.sum(~np.asarray(layout.has_power)) + np.sum(~np.asarray(layout.has_comms))
    assert len(advice.what_if) == lacks + 6
    gains = [effect.gain for effect in advice.what_if]
    assert gains == sorted(gains, reverse=True)
    assert {effect.change for effect in advice.what_if} == set(CHANGES)


def test_advising_again_compiles_nothing(scenario):
    """One compilation serves every state, layout and setting of the same sizes."""
    params, layout, state = scenario
    jitted = (advice_module._try_candidates, advice_module._play_layouts)
    advise(POLICY, params, layout, state, samples=4, what_if=True)
    compiled = [function._cache_size() for function in jitted]
    other_params, other_layout, other_state = mid_life(6, 6, uav_speed_m_s=8.0)
    advise(POLICY, params, layout, other_state, samples=4, what_if=True)
    advise(POLICY, params, layout, samples=4, what_if=True)
    advise(POLICY, other_params, other_layout, other_state, key=jax.random.key(9), samples=4, what_if=True)
    assert [function._cache_size() for function in jitted] == compiled


def test_a_batch_of_states_is_refused(scenario):
    params, layout, state = scenario
    states = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    with pytest.raises(AssertionError, match="shape"):
        advise(POLICY, params, layout, states, samples=4)


@pytest.mark.slow
def test_the_policys_own_choice_is_kept_where_nothing_is_better():
    """With power and communication everywhere and all devices at one place, no visit is better than another."""
    params, layout, _ = mid_life(0, 3)
    layout = layout.replace(has_power=jnp.ones(3, bool), has_comms=jnp.ones(3, bool), position=jnp.zeros((3, 2)))
    advice = advise(POLICY, params, layout, samples=8)
    assert advice.place == advice.policy_choice
    assert advice.forecast.first_failure.sum() == 0


@pytest.mark.slow
def test_forecasts_agree_with_independent_futures(scenario):
    """Probabilities from other futures agree within 4 standard errors."""
    params, layout, _ = scenario
    advice = advise(POLICY, params, layout, samples=256)

    def policy(params, layout, state, key=None):
        return jnp.where(state.slot == 0, advice.place, POLICY(params, layout, state, key))

    keys = jax.random.split(jax.random.key(99), 256)
    episodes = jax.jit(lambda: rollouts(policy, params, layout, keys))()
    share = np.asarray(episodes.first_failure).mean(axis=0)
    assert np.abs(share - advice.forecast.first_failure).max() < 4 * np.sqrt(2 * 0.25 / 256)
    lifetimes = advice.forecast.lifetimes
    error = 4 * np.sqrt(2) * max(lifetimes.std(), 0.5) / 16
    assert abs(np.asarray(episodes.length).mean() - lifetimes.mean()) < error


@pytest.mark.slow
def test_same_key_same_advice(scenario):
    params, layout, state = scenario
    first, again = (advise(POLICY, params, layout, state, key=jax.random.key(3), samples=32) for _ in range(2))
    assert_array_equal(first.forecast.lifetimes, again.forecast.lifetimes)
    start = advise(POLICY, params, layout, initial_state(params, layout), samples=32)
    assert_array_equal(start.forecast.lifetimes, advise(POLICY, params, layout, samples=32).forecast.lifetimes)


@pytest.mark.slow
def test_the_price_of_a_failure_counts(scenario):
    """Advice that knows the prices is worth at least as much as advice that does not."""
    params, layout, state = scenario
    free = advise(POLICY, params, layout, state, samples=SAMPLES)
    weight = jnp.asarray(free.forecast.first_failure, jnp.float32)[None]
    priced_layout = layout.replace(traffic=Traffic(weight, jnp.float32(jnp.inf), jnp.float32(50.0)))
    priced = advise(POLICY, params, priced_layout, state, samples=SAMPLES)
    price = 50.0 * np.asarray(weight[0])
    value = [
        forecast.lifetimes.mean() - forecast.first_failure @ price for forecast in (free.forecast, priced.forecast)
    ]
    assert value[1] >= value[0] - 1e-3
    assert all(candidate.behind >= -1e-3 for candidate in priced.candidates)


@pytest.mark.slow
def test_until_a_horizon_places_are_compared_by_service():
    scenario = hamlet()
    state = scenario.state.replace(elapsed=jnp.float32(1200.0), slot=jnp.int32(2))
    advice = advise(POLICY, scenario.params, scenario.layout, state, samples=8, what_if=True)
    for uav in advice.uavs:
        best = uav.candidates[0]
        for candidate in uav.candidates:
            assert 0 <= candidate.service <= 1
            assert_allclose(candidate.behind, best.service - candidate.service, atol=1e-6)
    assert_allclose(advice.forecast.service_s.mean() / 2400, advice.uavs[-1].candidates[0].service, rtol=1e-5)
    assert np.isnan(advice.forecast.failure_slot).all()
    assert advice.what_if[0].service is not None


def leave_in_turn(params, layout, state, key=None):
    """UAV 0 flies to the depot at once, UAV 1 in the third slot, UAV 2 never."""
    return jnp.where(state.slot >= jnp.array([0, 2, 99]), 3, jnp.arange(3)).astype(jnp.int32)


@pytest.mark.slow
def test_returns_to_a_depot():
    """Nothing can fail, so that the policy's own choices are taken."""
    layout, params = hamlet("first_failure").layout, hamlet("first_failure").params.replace(max_slots=5)
    layout = layout.replace(
        has_power=jnp.ones(3, bool), has_comms=jnp.ones(3, bool), fleet=make_fleet(params, 3, layout.depots)
    )
    first, second, third = advise(leave_in_turn, params, layout, samples=4).uavs
    assert [first.returns_in, first.returns_in_s] == [0, 0]
    assert second.returns_in == 2
    assert 0 < second.returns_in_s <= 1200
    assert np.isnan(third.returns_in)
    assert np.isnan(third.returns_in_s)

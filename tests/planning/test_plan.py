"""The plan for one scenario: its parts agree with each other."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tests.planning.instances import small_instance, traced
from uavmec_jax.env.dynamics import Cause
from uavmec_jax.env.rollout import rollout, tour_policy
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.plan import make_plan

pytestmark = pytest.mark.slow

DRAWS = jax.random.split(jax.random.key(0), 3)


@pytest.fixture(scope="module")
def instance():
    params, layout, _, _ = small_instance(3, devices=3)
    return traced(params), layout


@pytest.fixture(scope="module")
def plan(instance):
    return make_plan(*instance, DRAWS, width=16, samples=2)


def test_no_policy_exceeds_the_bound(plan):
    assert set(plan.lifetimes) == {*HEURISTICS, "rollout", "beam"}
    for lifetimes in plan.lifetimes.values():
        assert lifetimes.shape == plan.bound.shape == (3,)
        assert (lifetimes <= plan.bound).all()


def test_the_forecast_is_that_of_the_rollout_planner(plan):
    assert_array_equal(plan.forecast.lifetimes, plan.lifetimes["rollout"])


@pytest.mark.parametrize("name", ["rollout", "beam"])
def test_tours_are_those_of_the_first_draw(plan, instance, name):
    tour = plan.tours[name]
    assert tour.played.all()
    assert not (tour.outcome.cause == Cause.UAV).any()
    actions = np.append(tour.action, [tour.action[-1]] * 2).astype(np.int32)
    episode = jax.jit(lambda actions: rollout(tour_policy(actions), *instance, DRAWS[0]))(actions)
    assert episode.length == plan.lifetimes[name][0]


def test_what_if_gains_are_relative_to_the_rollout_planner(plan):
    now = plan.lifetimes["rollout"].mean()
    for effect in plan.what_if:
        assert effect.gain == pytest.approx(effect.lifetime - now)

"""Planners, forecasts and bounds refuse what cannot be before they compute."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import uavmec_jax as um
from uavmec_jax.env.rollout import volume_table
from uavmec_jax.planning.advice import advise
from uavmec_jax.planning.beam import beam_search
from uavmec_jax.planning.bound import upper_bound
from uavmec_jax.planning.forecast import make_forecast
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.plan import make_plan
from uavmec_jax.planning.rollout_planner import rollout_planner
from uavmec_jax.planning.service_bound import service_bound

KEY = jax.random.key(0)
PARAMS = um.Params()
LAYOUT = um.sample_layout(KEY, PARAMS, 8, 8)
VOLUMES = volume_table(PARAMS, 12, KEY, 64)
STAY = HEURISTICS["stay-put"]
BAD = LAYOUT.replace(position=LAYOUT.position.at[3].set(jnp.nan))
POSITION = r"^layout\.position of device 4 is nan; it should be a finite number"


def refused(line):
    return pytest.raises(um.ArgumentError, match=line)


def test_the_bound_certifies_nothing_about_positions_that_are_not_finite():
    with refused(POSITION):
        upper_bound(PARAMS, BAD, VOLUMES)
    with refused(POSITION):
        service_bound(PARAMS, BAD)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_the_bound_certifies_nothing_about_volumes_that_cannot_be(value):
    with refused("^volumes of entry 6, device 3 is"):
        upper_bound(PARAMS, LAYOUT, VOLUMES.at[5, 2].set(value))


def test_the_bound_certifies_nothing_about_parameters_that_cannot_be():
    with refused(r"^params\.uav_speed_m_s is -5"):
        upper_bound(um.Params(uav_speed_m_s=-5.0), LAYOUT, VOLUMES)
    with refused(r"^params\.horizon_s is nan"):
        service_bound(um.Params(horizon_s=float("nan")), LAYOUT)


def test_planners_refuse_positions_that_are_not_finite():
    for plan in (
        lambda: make_forecast(STAY, PARAMS, BAD),
        lambda: advise(STAY, PARAMS, BAD),
        lambda: make_plan(PARAMS, BAD, KEY[None]),
        lambda: beam_search(PARAMS, BAD, VOLUMES),
    ):
        with refused(POSITION):
            plan()


@pytest.mark.parametrize("samples", [0, -3])
def test_no_futures_are_refused(samples):
    for call in (
        lambda: make_forecast(STAY, PARAMS, LAYOUT, samples=samples),
        lambda: advise(STAY, PARAMS, LAYOUT, samples=samples),
        lambda: make_plan(PARAMS, LAYOUT, KEY[None], samples=samples),
        lambda: rollout_planner(samples=samples),
    ):
        with refused(rf"^samples is {samples}; it should be a whole number"):
            call()


def test_no_draws_and_no_width_are_refused():
    with refused("^the number of draws is 0; it should be a whole number of at least 1$"):
        make_plan(PARAMS, LAYOUT, jax.random.split(KEY, 0))
    with refused("^width is 0; it should be a whole number of at least 1$"):
        make_plan(PARAMS, LAYOUT, KEY[None], width=0)
    with refused("^width is 0; "):
        beam_search(PARAMS, LAYOUT, VOLUMES, width=0)


def test_a_state_that_cannot_be_is_refused():
    state = um.initial_state(PARAMS, LAYOUT)
    state = state.replace(uav_energy=jnp.array([jnp.nan]))
    for call in (make_forecast, advise):
        with refused(r"^state\.uav_energy of UAV 1 is nan; it should be a finite number from 0"):
            call(STAY, PARAMS, LAYOUT, state)

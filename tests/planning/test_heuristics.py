"""Heuristics and the rollout planner: which device they visit."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.small_scenarios import three_devices
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import rollout, trace
from uavmec_jax.planning.deadlines import earliest_deadline
from uavmec_jax.planning.heuristics import (
    HEURISTICS,
    lowest_battery,
    oldest_first,
    random,
    round_robin,
    shortest_life,
    stay_put,
)
from uavmec_jax.planning.rollout_planner import rollout_planner
from uavmec_jax.planning.shortest_tour import shortest_tour, two_opt
from uavmec_jax.scenarios.seeds import layout_for_seed

PARAMS, LAYOUT = Params(n_devices=3), three_devices()
START = initial_state(PARAMS, LAYOUT)
START_12 = initial_state(Params(), layout_for_seed(3, Params(), 8, 8))


def test_oldest_first_visits_the_oldest_data_and_the_lowest_index_on_ties():
    assert oldest_first(PARAMS, LAYOUT, START.replace(age=jnp.array([1, 5, 2]))) == 1
    assert oldest_first(PARAMS, LAYOUT, START.replace(age=jnp.array([3, 5, 5]))) == 1
    assert oldest_first(PARAMS, LAYOUT, START) == 0


def test_round_robin_cycles_through_the_devices():
    visits = [int(round_robin(PARAMS, LAYOUT, START.replace(slot=jnp.int32(slot)))) for slot in range(7)]
    assert visits == [0, 1, 2, 0, 1, 2, 0]


def test_stay_put_stays_at_the_first_device():
    assert stay_put(PARAMS, LAYOUT, START.replace(age=jnp.array([1, 5, 2]))) == 0


def test_random_visits_all_devices_evenly():
    visits = jax.vmap(lambda key: random(PARAMS, LAYOUT, START, key))(jax.random.split(jax.random.key(0), 3000))
    assert np.bincount(visits, minlength=3).min() > 900
    with pytest.raises(ValueError, match="needs a key"):
        random(PARAMS, LAYOUT, START)


@pytest.mark.parametrize("transform", [jax.jit, lambda function: function], ids=["jit", "no-jit"])
@pytest.mark.parametrize("name", HEURISTICS)
def test_actions_are_int32_under_vmap(name, transform):
    policy = HEURISTICS[name]
    keys = jax.random.split(jax.random.key(0), 4)
    states = jax.vmap(lambda _: START)(keys)
    actions = transform(jax.vmap(lambda state, key: policy(PARAMS, LAYOUT, state, key)))(states, keys)
    assert actions.shape == (4,)
    assert actions.dtype == jnp.int32


def test_lowest_battery_compares_fractions():
    state = START.replace(battery=jnp.array([50_000.0, 30_000.0, 40_000.0]))
    assert lowest_battery(PARAMS, LAYOUT, state) == 1
    assert lowest_battery(PARAMS, LAYOUT, START) == 0


def test_shortest_life_compares_batteries_with_ages():
    # A slot lasts 600 s at most and data 11 slots; a full battery outlasts them even where it loses (4 + 2.5) W.
    shortest = jax.jit(shortest_life)
    assert shortest(PARAMS, LAYOUT, START.replace(age=jnp.array([3, 8, 2]))) == 1
    low = START.replace(battery=jnp.array([60_000.0, 60_000.0, 3_000.0]))
    assert shortest(PARAMS, LAYOUT, low) == 2
    assert shortest(PARAMS, LAYOUT.replace(has_power=jnp.array([True, True, True])), low) == 0


def test_earliest_deadline_collects_data_just_in_time_and_serves_batteries_in_between():
    layout = layout_for_seed(3, Params(), 8, 8)
    slots = jax.jit(lambda key: trace(earliest_deadline, Params(), layout, key, 18))(jax.random.key(0))
    played = np.asarray(slots.played)
    visits = np.asarray(slots.action)[played]
    unconnected = np.flatnonzero(~np.asarray(layout.has_comms))
    assert np.asarray(slots.state.age)[played].max() <= 10
    assert set(unconnected) <= set(visits[:11].tolist())
    weakest = int(np.asarray(slots.state.battery / layout.capacity)[-1].argmin())
    assert not layout.has_power[weakest]
    assert np.bincount(visits).argmax() == weakest  # slots that the ages can spare go to the battery that empties first


def test_earliest_deadline_stays_where_no_visit_is_needed():
    layout = layout_for_seed(0, Params(), 12, 12)
    state = initial_state(Params(), layout).replace(uav_position=layout.position[7:8])
    assert jax.jit(earliest_deadline)(Params(), layout, state) == 7


def test_devices_that_share_a_hover_point_share_a_visit():
    # The device in the middle is in range of both others, which are out of range of each other.
    chain = jnp.array([[100.0, 100.0], [150.0, 100.0], [200.0, 100.0]])
    layout = three_devices(has_power=(True, True, True), position=chain)
    state = START.replace(age=jnp.array([10, 10, 10]))
    assert jax.jit(earliest_deadline)(PARAMS, layout, state) == 1


def test_shortest_tour_visits_all_devices_that_lack_something():
    layout = layout_for_seed(5, Params(), 6, 6)
    needy = np.flatnonzero(~np.asarray(layout.has_power & layout.has_comms))
    policy = jax.jit(shortest_tour)
    order = [int(policy(Params(), layout, START_12.replace(slot=jnp.int32(slot)))) for slot in range(len(needy))]
    assert sorted(order) == needy.tolist()
    position = np.asarray(layout.position)
    best = min(length(position[[needy[0], *rest]]) for rest in itertools.permutations(needy[1:]) if len(needy) <= 9)
    assert length(position[order]) <= 1.05 * best


def length(stops):
    return np.linalg.norm(stops - np.roll(stops, 1, axis=0), axis=1).sum()


def test_two_opt_removes_crossings():
    square = jnp.array([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0], [9.0, 9.0]])
    tour = jax.jit(two_opt)(square, jnp.arange(5), jnp.int32(4))
    assert length(np.asarray(square)[np.asarray(tour)[:4]]) == pytest.approx(4.0)
    assert tour[4] == 4


def test_rollout_planner_is_a_function_of_its_key_alone():
    layout = layout_for_seed(3, Params(), 8, 8)
    policy = rollout_planner(samples=2)
    with pytest.raises(ValueError, match="needs a key"):
        policy(Params(), layout, START_12)
    first = jax.jit(lambda key: policy(Params(), layout, START_12, key))
    # Its choice depends on its own key: the volumes of the slot are not among its arguments.
    assert first(jax.random.key(1)) == first(jax.random.key(1))


@pytest.mark.slow
def test_rollout_planner_improves_on_its_base():
    layouts = [layout_for_seed(seed, Params(), 8, 8) for seed in range(6)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *layouts)
    keys = jax.random.split(jax.random.key(0), 6)

    def lifetimes(policy):
        return jax.jit(jax.vmap(lambda layout, key: rollout(policy, Params(), layout, key).length))(stacked, keys)

    assert lifetimes(rollout_planner(oldest_first, samples=2)).mean() > lifetimes(oldest_first).mean()

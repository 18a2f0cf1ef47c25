"""The environment: signatures, automatic resets, observations, lifetimes worked out by hand, invariants."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from tests.populations import stack, take
from uavmec_jax.env.dynamics import Cause, initial_state, transition
from uavmec_jax.env.environment import UavMecEnv
from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.observation import observe
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import rollout, rollouts
from uavmec_jax.env.scenario import make_scenario
from uavmec_jax.planning.heuristics import HEURISTICS, oldest_first
from uavmec_jax.planning.observation import FEATURES, observe_devices

ENV = UavMecEnv()
PARAMS = Params()

both_modes = pytest.mark.usefixtures("with_and_without_jit")


def layout_of(seed, powered=8, connected=8, params=PARAMS):
    return sample_layout(jax.random.key(seed), params, powered, connected)


@both_modes
def test_first_observation_is_ones_then_zeros():
    observation, state = ENV.reset(jax.random.key(0))
    assert_allclose(observation, [1.0] * 12 + [0.0] * 12, rtol=2e-7)  # a GPU divides to the last bit but one
    assert observation.dtype == jnp.float32
    assert state.slot == 0


@both_modes
def test_step_resets_automatically_and_keeps_the_final_observation():
    scenario = make_scenario(layout_of(0, 12, 0))
    observation, state = ENV.reset(jax.random.key(0), scenario)
    for slot in range(11):
        previous = state
        observation, state, _, terminated, truncated, info = ENV.step(jax.random.key(slot), state, 0, scenario)
        assert info["length"] == slot + 1
        assert bool(terminated) == (slot == 10)
        assert not truncated
        assert previous.slot == slot
    assert info["cause"] == Cause.DATA_AGE
    assert info["final_observation"][12:].max() == 11
    assert_allclose(observation, [1.0] * 12 + [0.0] * 12, rtol=2e-7)  # a GPU divides to the last bit but one
    assert state.slot == 0


@both_modes
def test_time_limit_truncates():
    scenario = make_scenario(layout_of(0, 12, 12), Params(max_slots=3))
    _, state = ENV.reset(jax.random.key(0), scenario)
    flags = []
    for slot in range(3):
        _, state, _, terminated, truncated, _ = ENV.step(jax.random.key(slot), state, 0, scenario)
        flags.append((bool(terminated), bool(truncated)))
    assert flags == [(False, False), (False, False), (False, True)]
    assert state.slot == 0


def test_everything_powered_and_connected_lives_33_slots():
    # 1,600 kJ / (80 W x 600 s) = 33.3 slots, if at least one device computes for the full 600 s.
    keys = jax.random.split(jax.random.key(0), 20)
    play = lambda key: rollout(HEURISTICS["stay-put"], PARAMS, sample_layout(key, PARAMS, 12, 12), key)  # noqa: E731
    episodes = jax.jit(jax.vmap(play))(keys)
    assert_array_equal(episodes.length, 33)
    assert_array_equal(episodes.cause, Cause.UAV)
    assert not episodes.failed.any()


@pytest.mark.slow
def test_nothing_powered_or_connected_lives_11_slots_without_shared_hover_points():
    params = Params(uav_signal_range_m=11.0)  # altitude 10 m: no other device within 4.6 m on the ground
    keys = jax.random.split(jax.random.key(0), 20)
    for policy in HEURISTICS.values():
        episodes = jax.vmap(lambda key, p=policy: rollout(p, params, sample_layout(key, params, 0, 0), key))(keys)
        assert_array_equal(episodes.length, 11)


@both_modes
def test_rollout_gives_two_policies_the_same_volumes():
    batteries = {}

    def recording(name, action):
        def policy(params, layout, state, key=None):
            jax.debug.callback(
                lambda battery, slot: batteries.setdefault((name, int(slot)), np.asarray(battery)),
                state.battery,
                state.slot,
            )
            return jnp.int32(action)

        return policy

    layout = layout_of(2, 0, 12)
    for name in ("a", "b"):
        rollout(recording(name, 3), PARAMS, layout, jax.random.key(7))
    jax.effects_barrier()
    slots = {slot for _, slot in batteries}
    assert len(slots) > 5
    for slot in slots:
        assert_array_equal(batteries["a", slot], batteries["b", slot])


@pytest.mark.slow
def test_rollouts_differ_by_draw_and_repeat_by_key():
    keys = jax.random.split(jax.random.key(0), 16)
    first = rollouts(oldest_first, PARAMS, layout_of(5, 4, 4), keys)
    again = rollouts(oldest_first, PARAMS, layout_of(5, 4, 4), keys)
    chex.assert_trees_all_equal(first, again)
    alone = rollout(oldest_first, PARAMS, layout_of(5, 4, 4), keys[3])
    assert alone.length == first.length[3]
    durations = [
        transition(PARAMS, layout_of(5, 4, 4), initial_state(PARAMS, layout_of(5, 4, 4)), jnp.int32(0), volumes)[
            1
        ].duration
        for volumes in jax.random.uniform(keys[0], (2, 12), minval=2e5, maxval=4e5)
    ]
    assert durations[0] != durations[1]


@pytest.mark.slow
@pytest.mark.bits
def test_jit_and_vmap_change_nothing():
    layouts = jax.vmap(lambda key: sample_layout(key, PARAMS, 6, 6))(jax.random.split(jax.random.key(0), 5))
    volumes = jax.random.uniform(jax.random.key(1), (5, 12), minval=2e6, maxval=4e6)
    states = jax.vmap(lambda layout: initial_state(PARAMS, layout))(layouts)
    actions = jnp.arange(5, dtype=jnp.int32)
    step = lambda *args: transition(PARAMS, *args)  # noqa: E731
    batched = jax.vmap(step)(layouts, states, actions, volumes)
    jitted = jax.jit(jax.vmap(step))(layouts, states, actions, volumes)
    alone = [step(*take((layouts, states, actions, volumes), i)) for i in range(5)]
    for many in (batched, jitted):
        chex.assert_trees_all_close(stack(alone), many, rtol=2e-6)


states = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 10_000),
        "n": st.sampled_from([2, 5, 12, 64]),
        "slots": st.integers(1, 8),
        "power": st.floats(0, 1),
        "comms": st.floats(0, 1),
    }
)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(states)
def test_invariants_of_random_play(case):
    n = case["n"]
    params = Params(n_devices=n)
    key = jax.random.key(case["seed"])
    layout = sample_layout(key, params, int(case["power"] * n), int(case["comms"] * n))
    state = initial_state(params, layout)
    for slot in range(case["slots"]):
        k_action, k_volumes = jax.random.split(jax.random.fold_in(key, slot))
        action = jax.random.randint(k_action, (), 0, n)
        volumes = jax.random.uniform(k_volumes, (n,), minval=2e6, maxval=4e6)
        before = state
        state, outcome = transition(params, layout, before, action, volumes)
        assert (state.battery <= before.battery).all()
        assert state.uav_energy <= before.uav_energy
        assert (state.age >= 0).all()
        assert (state.age <= 11).all()
        assert_array_equal(state.battery[layout.has_power], layout.capacity[layout.has_power])
        assert_array_equal(state.age[layout.has_comms], 0)
        assert_array_equal(state.age[outcome.served], 0)
        observation = observe(params, layout, state)
        assert (observation[:n] >= 0).all()
        assert (observation[:n] <= 1).all()
        if outcome.cause in (Cause.BATTERY, Cause.DATA_AGE):
            assert outcome.failed.any()
            assert_allclose(outcome.first_failure.sum(), 1.0, rtol=1e-6)
        else:
            assert not outcome.failed.any()
        if outcome.cause != Cause.NONE:
            break


def test_one_program_serves_all_scenarios_of_one_size():
    step = jax.jit(chex.assert_max_traces(transition, n=1))
    for params, layout in (
        (PARAMS, layout_of(0)),
        (PARAMS.replace(uav_speed_m_s=8.0, max_slots=5), layout_of(1, 4, 12)),
    ):
        step(params, layout, initial_state(params, layout), jnp.int32(0), jnp.full(12, 3e6))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 11))
def test_renumbering_the_devices_renumbers_the_outcome(seed, action):
    key = jax.random.key(seed)
    layout = sample_layout(key, PARAMS, 6, 6)
    volumes = jax.random.uniform(key, (12,), minval=2e6, maxval=4e6)
    order = jax.random.permutation(key, 12)
    renumbered = jax.tree.map(lambda leaf: leaf[order], layout)
    new_action = jnp.argmax(order == action).astype(jnp.int32)
    state, outcome = transition(PARAMS, layout, initial_state(PARAMS, layout), jnp.int32(action), volumes)
    other, other_outcome = transition(PARAMS, renumbered, initial_state(PARAMS, renumbered), new_action, volumes[order])
    assert_allclose(other.battery, state.battery[order], rtol=1e-6)
    assert_array_equal(other.age, state.age[order])
    assert_array_equal(other_outcome.served, outcome.served[order])
    assert_allclose(other_outcome.duration, outcome.duration, rtol=1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_seeds_differ_and_repeat(seed):
    same = layout_of(seed), layout_of(seed)
    chex.assert_trees_all_equal(*same)
    assert (layout_of(seed).position != layout_of(seed + 1).position).any()


@pytest.mark.slow
def test_another_observation_fn():
    """With the full observation the environment plays the same slots and also returns the final observation."""
    scenario = make_scenario()
    plain, full = UavMecEnv(), UavMecEnv(observation_fn=observe_devices)
    observation, state = full.reset(jax.random.key(0), scenario)
    _, same = plain.reset(jax.random.key(0), scenario)
    for number in range(12):  # visiting one device over and over: the data of the others expire
        key = jax.random.key(number)
        observation, state, reward, ended, _, info = full.step(key, state, 3, scenario)
        _, same, other_reward, other_end, _, _ = plain.step(key, same, 3, scenario)
        assert (float(reward), bool(ended)) == (float(other_reward), bool(other_end))
        if ended:
            break
    assert bool(ended)
    age = [feature.name for feature in FEATURES].index("age")
    assert float(jnp.max(info["final_observation"].features[:, age])) == 1.0
    assert float(jnp.max(observation.features[:, age])) == 0.0
    assert_array_equal(state.age, same.age)

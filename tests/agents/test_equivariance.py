"""The permutation-equivariant networks: any number of devices, in any order, with padding."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.populations import take
from tests.small_scenarios import mid_life
from uavmec_jax.agents import dqn, ppo, pqn
from uavmec_jax.agents.equivariant_networks import ABSENT_LOGIT, sum_over_devices
from uavmec_jax.agents.observation_spec import OBSERVATIONS
from uavmec_jax.env.padding import pad_layout
from uavmec_jax.planning.observation import FEATURES, observe_devices

SPEC = ppo.PPOSpec(hidden=(16, 24), observation="full", n_envs=4, n_steps=8, batch_size=16)
Q_SPEC = pqn.PQNSpec(hidden=(16, 24), observation="full")


@functools.cache
def initial_weights():
    return SPEC.network.init(jax.random.key(3), jnp.zeros((1, SPEC.obs_size)))


def logits_and_value(params, layout, state):
    """Return the logits and the value of one state."""
    return apply_network(initial_weights(), params, layout, state)


@jax.jit
def apply_network(weights, params, layout, state):
    observation = OBSERVATIONS["full"].observation_fn(params, layout, state)
    logits, value = SPEC.network.apply(weights, observation[None])
    return logits[0], value[0]


@functools.cache
def initial_q_weights():
    weights = Q_SPEC.network.init(jax.random.key(4), jnp.zeros((1, Q_SPEC.obs_size)))
    score = weights["params"]["score"]  # Q-values of new weights are almost equal; these are not
    return {"params": weights["params"] | {"score": {**score, "kernel": 100.0 * score["kernel"]}}}


def q_values(params, layout, state):
    """Return the Q-values of one state."""
    return apply_q_network(initial_q_weights(), params, layout, state)


@jax.jit
def apply_q_network(weights, params, layout, state):
    observation = OBSERVATIONS["full"].observation_fn(params, layout, state)
    return Q_SPEC.network.apply(weights, observation[None])[0]


def pad_state(state, entries):
    """The state with entries after it that are not devices."""
    battery = jnp.pad(state.battery, (0, entries), constant_values=1.0)
    return state.replace(battery=battery, age=jnp.pad(state.age, (0, entries)))


def permuted(order, layout, state):
    return take(layout, order), state.replace(battery=state.battery[order], age=state.age[order])


@pytest.mark.bits
@pytest.mark.parametrize("n", [*(pytest.param(n, marks=pytest.mark.slow) for n in (2, 12, 24, 64)), 5])
def test_permuting_devices_permutes_the_logits_and_keeps_the_value(n):
    rng = np.random.default_rng(n)
    for seed in range(6):
        params, layout, state = mid_life(seed, n)
        logits, value = logits_and_value(params, layout, state)
        order = rng.permutation(n)
        permuted_logits, permuted_value = logits_and_value(params, *permuted(order, layout, state))
        assert_array_equal(permuted_logits, np.asarray(logits)[order])
        assert_array_equal(permuted_value, value)


@pytest.mark.bits
@pytest.mark.parametrize("n", [*(pytest.param(n, marks=pytest.mark.slow) for n in (2, 12, 64)), 5])
def test_permuting_devices_permutes_the_q_values(n):
    rng = np.random.default_rng(n)
    for seed in range(6):
        params, layout, state = mid_life(seed, n)
        values, order = np.asarray(q_values(params, layout, state)), rng.permutation(n)
        assert np.ptp(values) > 0.01
        assert_array_equal(q_values(params, *permuted(order, layout, state)), values[order])


def test_dqn_and_pqn_have_the_same_network():
    spec = dqn.DQNSpec(hidden=(16, 24), observation="full", layer_norm=True)
    assert (spec.network, spec.obs_size) == (Q_SPEC.network, Q_SPEC.obs_size)
    params, layout, state = mid_life(0, spec.n_devices)
    observation = OBSERVATIONS["full"].observation_fn(params, layout, state)
    values = dqn.q_values(spec, dqn.DQNHyper(age_scale=7.0), initial_q_weights(), observation)
    assert_allclose(values, q_values(params, layout, state), rtol=1e-5)
    twice = dqn.greedy_action(spec, dqn.DQNHyper(), initial_q_weights(), jnp.stack([observation] * 2)[:, None])
    assert_array_equal(twice, np.full((2, 1), np.argmax(values)))


@pytest.mark.bits
def test_padding_changes_no_q_value_and_may_be_anywhere():
    params, layout, state = mid_life(2, 5)
    values = np.asarray(q_values(params, layout, state))
    padded = pad_layout(layout, 8), pad_state(state, 3)
    padded_values = np.asarray(q_values(params, *padded))
    assert_allclose(padded_values[:5], values, rtol=1e-5, atol=1e-6)
    assert_array_equal(padded_values[5:], np.full(3, ABSENT_LOGIT, np.float32))
    order = np.random.default_rng(0).permutation(8)
    assert_array_equal(q_values(params, *permuted(order, *padded)), padded_values[order])


def test_the_mean_of_the_q_values_is_the_value_of_the_state():
    """The heads are dueling: doubling the scores doubles the distances from the mean and keeps it."""
    params, layout, state = mid_life(2, 5)
    padded = params, pad_layout(layout, 7), pad_state(state, 2)
    weights = initial_q_weights()["params"]
    doubled = weights | {"score": jax.tree.map(lambda leaf: 2.0 * leaf, weights["score"])}
    single, double = (apply_q_network({"params": w}, *padded)[:5] for w in (weights, doubled))
    assert_allclose(double.mean(), single.mean(), rtol=1e-4, atol=1e-4)
    assert_allclose(double - double.mean(), 2 * (single - single.mean()), rtol=1e-4, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("n", [3, 12])
def test_padding_changes_nothing(n):
    params, layout, state = mid_life(1, n)
    logits, value = logits_and_value(params, layout, state)
    padded_logits, padded_value = logits_and_value(params, pad_layout(layout, n + 4), pad_state(state, 4))
    chex.assert_trees_all_close((padded_logits[:n], padded_value), (logits, value), rtol=1e-5, atol=1e-6)
    assert_array_equal(padded_logits[n:], np.full(4, ABSENT_LOGIT, np.float32))


@pytest.mark.slow
@pytest.mark.bits
def test_padding_may_be_anywhere():
    params, layout, state = mid_life(2, 5)
    padded = pad_layout(layout, 8), pad_state(state, 3)
    order = np.random.default_rng(0).permutation(8)
    logits, _ = logits_and_value(params, *padded)
    permuted_logits, _ = logits_and_value(params, *permuted(order, *padded))
    assert_array_equal(permuted_logits, np.asarray(logits)[order])


def test_sum_does_not_depend_on_the_order():
    x = jax.random.normal(jax.random.key(0), (3, 64, 5)) * 10.0
    order = np.random.default_rng(1).permutation(64)
    total = sum_over_devices(x)
    assert_array_equal(total, sum_over_devices(x[:, order]))
    assert_allclose(total, jnp.sum(x, axis=1), atol=64 * 2.0**-16)
    gradient = jax.grad(lambda x: jnp.sum(sum_over_devices(x) ** 2))(x)
    assert_allclose(gradient, jnp.broadcast_to(2 * jnp.sum(x, 1, keepdims=True), x.shape), atol=0.01)


@pytest.mark.slow
def test_masked_actions_are_never_sampled():
    params, layout, state = mid_life(4, 3)
    logits, _ = logits_and_value(params, pad_layout(layout, 6), pad_state(state, 3))
    assert_array_equal(np.asarray(jax.nn.softmax(logits))[3:], 0.0)


def test_names_of_features_are_unique():
    names = [feature.name for feature in FEATURES]
    observation = jax.eval_shape(observe_devices, *mid_life(0, 4))
    assert len(set(names)) == len(names) == observation.features.shape[-1]

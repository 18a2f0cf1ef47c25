"""The networks for the full observation: any number of devices, in any order, with padding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tests.small_scenarios import mid_life
from uavmec_jax.agents import ppo
from uavmec_jax.agents.networks import ABSENT_LOGIT, sum_over_devices
from uavmec_jax.agents.observation_spec import OBSERVATIONS
from uavmec_jax.env.layout import pad_layout
from uavmec_jax.planning.observation import FEATURES, observe_devices

SPEC = ppo.PPOSpec(hidden=(16, 24), observation="full", n_envs=4, n_steps=8, batch_size=16)
WEIGHTS = SPEC.network.init(jax.random.key(3), jnp.zeros((1, SPEC.words)))


@jax.jit
def judge(params, layout, state):
    """Logits and value of one state."""
    seen = OBSERVATIONS["full"].see(params, layout, state)
    logits, value = SPEC.network.apply(WEIGHTS, seen[None])
    return logits[0], value[0]


def permuted(order, layout, state):
    take = lambda leaf: leaf[order]  # noqa: E731
    return jax.tree.map(take, layout), state.replace(battery=state.battery[order], age=state.age[order])


@pytest.mark.bits
@pytest.mark.parametrize("n", [*(pytest.param(n, marks=pytest.mark.slow) for n in (2, 24, 64)), 5, 12])
def test_permuting_devices_permutes_the_logits_and_nothing_else(n):
    rng = np.random.default_rng(n)
    for seed in range(6):
        params, layout, state = mid_life(seed, n)
        logits, value = judge(params, layout, state)
        order = rng.permutation(n)
        shuffled, same = judge(params, *permuted(order, layout, state))
        assert_array_equal(shuffled, np.asarray(logits)[order])
        assert_array_equal(same, value)


@pytest.mark.slow
@pytest.mark.parametrize("n", [3, 12])
def test_padding_changes_nothing(n):
    params, layout, state = mid_life(1, n)
    logits, value = judge(params, layout, state)
    padded = pad_layout(layout, n + 4)
    more = state.replace(battery=jnp.pad(state.battery, (0, 4), constant_values=1.0), age=jnp.pad(state.age, (0, 4)))
    wide, same = judge(params, padded, more)
    np.testing.assert_allclose(wide[:n], logits, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(same, value, rtol=1e-5, atol=1e-6)
    assert_array_equal(wide[n:], np.full(4, ABSENT_LOGIT, np.float32))


@pytest.mark.slow
@pytest.mark.bits
def test_padding_may_stand_anywhere():
    params, layout, state = mid_life(2, 5)
    padded = pad_layout(layout, 8)
    more = state.replace(battery=jnp.pad(state.battery, (0, 3), constant_values=1.0), age=jnp.pad(state.age, (0, 3)))
    order = np.random.default_rng(0).permutation(8)
    logits, _ = judge(params, padded, more)
    shuffled, _ = judge(params, *permuted(order, padded, more))
    assert_array_equal(shuffled, np.asarray(logits)[order])


def test_sum_does_not_depend_on_the_order():
    x = jax.random.normal(jax.random.key(0), (3, 64, 5)) * 10.0
    order = np.random.default_rng(1).permutation(64)
    found = sum_over_devices(x)
    assert_array_equal(found, sum_over_devices(x[:, order]))
    np.testing.assert_allclose(found, jnp.sum(x, axis=1), atol=64 * 2.0**-16)
    gradient = jax.grad(lambda x: jnp.sum(sum_over_devices(x) ** 2))(x)
    np.testing.assert_allclose(gradient, jnp.broadcast_to(2 * jnp.sum(x, 1, keepdims=True), x.shape), atol=0.01)


@pytest.mark.slow
def test_masked_actions_are_never_drawn():
    params, layout, state = mid_life(4, 3)
    padded = pad_layout(layout, 6)
    more = state.replace(battery=jnp.pad(state.battery, (0, 3), constant_values=1.0), age=jnp.pad(state.age, (0, 3)))
    logits, _ = judge(params, padded, more)
    assert_array_equal(np.asarray(jax.nn.softmax(logits))[3:], 0.0)


def test_features_are_named_once():
    names = [feature.name for feature in FEATURES]
    seen = jax.eval_shape(observe_devices, *mid_life(0, 4))
    assert len(set(names)) == len(names) == seen.features.shape[-1]

"""The targets of Q-learning against sums written out slot by slot."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from uavmec_jax.agents.q_targets import lambda_returns, values_of, widen_gap


def return_from(start, reward, value, last_value, ended, greedy, gamma, q_lambda):
    """Return the lambda-return of one environment from a slot: the mean of its n-step returns.

    The n-step return has weight ``(1 - lambda) lambda**(n - 1)``. The longest one, which has all the remaining weight, ends
    with the episode or the rollout, or before an action that was not greedy.
    """
    values, rewards, weight, total = [*value, last_value], 0.0, 1.0, 0.0
    for n in range(1, len(reward) - start + 1):
        slot = start + n - 1
        rewards += gamma ** (n - 1) * reward[slot]
        bootstrap = 0.0 if ended[slot] else gamma**n * values[slot + 1]
        longest = ended[slot] or slot + 1 == len(reward) or not greedy[slot + 1]
        total += weight * (1.0 if longest else 1.0 - q_lambda) * (rewards + bootstrap)
        weight *= q_lambda
        if longest:
            return total
    raise AssertionError("the last slot ends every return")


@pytest.mark.parametrize("q_lambda", [0.0, 0.65, 1.0])
@pytest.mark.parametrize("cut", [False, True])
def test_lambda_returns_are_means_of_n_step_returns(jit, q_lambda, cut):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        reward, value = rng.normal(size=(2, 12, 3)).astype(np.float32)
        last_value = rng.normal(size=3).astype(np.float32)
        ended = rng.random((12, 3)) < 0.2
        greedy = (rng.random((12, 3)) < 0.6) | (not cut)
        expected = [
            [
                return_from(t, reward[:, e], value[:, e], last_value[e], ended[:, e], greedy[:, e], 0.9, q_lambda)
                for e in range(3)
            ]
            for t in range(12)
        ]
        arrays = map(jnp.asarray, (reward, value, last_value, ended, greedy))
        assert_allclose(jit(lambda_returns)(*arrays, 0.9, q_lambda), expected, rtol=1e-5, atol=1e-5)


def test_a_cut_return_by_hand():
    reward, value = jnp.array([[1.0], [2.0], [4.0]]), jnp.array([[50.0], [10.0], [20.0]])
    arguments = (jnp.array([30.0]), jnp.zeros((3, 1), bool))
    uncut = lambda_returns(reward, value, *arguments, jnp.array([[True], [True], [True]]), 0.5, 1.0)
    assert_array_equal(uncut[:, 0], [1 + 1 + 1 + 3.75, 2 + 2 + 7.5, 4 + 15])
    # the action of slot 1 was not greedy, so the return from slot 0 takes the value of the state before it
    cut = lambda_returns(reward, value, *arguments, jnp.array([[True], [False], [True]]), 0.5, 1.0)
    assert_array_equal(cut[:, 0], [1 + 5, 2 + 2 + 7.5, 4 + 15])
    # whether the first action of a return was greedy does not matter
    first = lambda_returns(reward, value, *arguments, jnp.array([[False], [True], [True]]), 0.5, 1.0)
    assert_array_equal(first, uncut)


def test_nothing_passes_the_end_of_an_episode():
    reward, value = jnp.ones((3, 1)), jnp.full((3, 1), 7.0)
    ended, greedy = jnp.array([[False], [True], [False]]), jnp.full((3, 1), True)
    returns = lambda_returns(reward, value, jnp.array([100.0]), ended, greedy, 1.0, 1.0)
    assert_array_equal(returns[:, 0], [2.0, 1.0, 101.0])


def test_widen_gap_by_hand():
    q_values = jnp.array([[1.0, 5.0, 3.0], [2.0, 2.0, -2.0]])
    target = jnp.array([10.0, 20.0])
    assert_array_equal(values_of(q_values, jnp.array([2, 0])), [3.0, 2.0])
    assert_array_equal(widen_gap(target, q_values, jnp.array([2, 2]), 0.5), [10 - 0.5 * 2, 20 - 0.5 * 4])
    assert_array_equal(widen_gap(target, q_values, jnp.array([1, 0]), 0.5), target)  # greedy actions keep theirs
    assert_array_equal(widen_gap(target, q_values, jnp.array([0, 2]), 0.0), target)

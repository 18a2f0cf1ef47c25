"""Rewards against values computed by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.small_scenarios import three_devices
from uavmec_jax.env.dynamics import State
from uavmec_jax.env.rewards import REWARDS, TERMS, make_reward, make_weights, needs_guard, reward_of, reward_terms

LAYOUT = three_devices()


def state(age, battery=(6e4, 6e4, 6e4), slot=0):
    return State(jnp.array(battery), jnp.array(age, jnp.int32), jnp.zeros((1, 2)), jnp.array([1e6]), jnp.int32(slot))


# Visit device 1, aged 3, while the oldest data are 7 slots old; afterwards 5 slots are done and the lowest battery is at
# 15,000 / 60,000 = 0.25.
BEFORE, AFTER = state([7, 3, 0], slot=4), state([8, 0, 1], (6e4, 1.5e4, 3e4), slot=5)
EXPECTED = {
    "A": 3,
    "U": 5,
    "M": 0.25,
    "-O": -7,
    "A+U+M-O": 1.25,
    "log A": np.log(3),
    "log U": np.log(5),
    "log M": np.log(0.25),
    "-log O": -np.log(7),
    "log A+log U+log M-log O": np.log(3 * 5 * 0.25 / 7),
    "U+log(A/O)": 5 + np.log(3 / 7),
}


def test_the_rewards_are_the_eleven_of_table_6():
    assert list(REWARDS) == list(EXPECTED)
    assert all(weights.shape == (8,) for weights in REWARDS.values())


@pytest.mark.parametrize("name", EXPECTED)
def test_value(name):
    assert_allclose(reward_of(make_reward(name), LAYOUT, BEFORE, jnp.int32(1), AFTER), EXPECTED[name], rtol=1e-6)


def test_log1p_shifts_the_ages_only():
    terms = dict(zip(TERMS, reward_terms(LAYOUT, BEFORE, jnp.int32(1), AFTER, log1p=True), strict=True))
    assert_allclose(terms["log A"], np.log(4), rtol=1e-6)
    assert_allclose(terms["log O"], np.log(8), rtol=1e-6)
    assert_allclose(terms["log U"], np.log(5), rtol=1e-6)
    assert_allclose(terms["log M"], np.log(0.25), rtol=1e-6)


def test_clamp_punishes_visiting_fresh_data():
    # A = 0, O = 7: U + log(1e-6) - log(7) = 5 - 13.815511 - 1.945910 = -10.761421
    reward = reward_of(make_reward("U+log(A/O)"), LAYOUT, BEFORE, jnp.int32(2), AFTER)
    assert_allclose(reward, -10.761421, rtol=1e-6)


def test_all_fresh_cancels():
    # A = O = 0: the two guarded logarithms cancel, U stays.
    assert_allclose(reward_of(make_reward("U+log(A/O)"), LAYOUT, state([0, 0, 0]), jnp.int32(0), AFTER), 5.0, atol=1e-5)


@pytest.mark.parametrize("guard", ["clamp", "log1p"])
def test_empty_battery_is_finite(guard):
    empty = state([1, 1, 1], (0.0, 6e4, 6e4), slot=3)
    value = reward_of(make_reward("log M", guard), LAYOUT, BEFORE, jnp.int32(1), empty)
    assert_allclose(value, np.log(1e-6), rtol=1e-6)


def test_custom_weights():
    reward = make_reward({"U": 2.0, "O": -0.5})
    assert_allclose(reward_of(reward, LAYOUT, BEFORE, jnp.int32(1), AFTER), 2 * 5 - 0.5 * 7, rtol=1e-6)


def test_errors_name_what_is_unknown():
    with pytest.raises(ValueError, match="unknown reward 'X'"):
        make_reward("X")
    with pytest.raises(
        ValueError, match="unknown reward term 'Q'; terms are A, U, M, O, log A, log U, log M, log O, S"
    ):
        make_weights({"Q": 1.0})
    with pytest.raises(ValueError, match="should be a finite number"):
        make_weights({"A": float("nan")})
    with pytest.raises(ValueError, match="weight of reward term 'S' is nan; it should be a finite number"):
        make_reward({"S": float("nan")})
    with pytest.raises(ValueError, match="unknown log guard"):
        make_reward("A", "none")


def test_a_function_of_the_terms_is_a_reward():
    product = make_reward(lambda terms: terms["U"] * terms["M"] - jnp.where(terms["O"] > 5, 2.0, 0.0))
    assert_allclose(reward_of(product, LAYOUT, BEFORE, jnp.int32(1), AFTER), 5 * 0.25 - 2)
    guarded = make_reward(lambda terms: terms["log A"], guard="log1p")
    assert_allclose(reward_of(guarded, LAYOUT, BEFORE, jnp.int32(1), AFTER), np.log(4), rtol=1e-6)


def test_the_function_is_checked_when_it_is_given():
    with pytest.raises(ValueError, match=r"asks for the term 'Q'; terms are A, U, M, O, log A"):
        make_reward(lambda terms: terms["Q"])
    with pytest.raises(ValueError, match=r"returns an array of shape \(2,\); it should return a scalar"):
        make_reward(lambda terms: jnp.stack([terms["A"], terms["U"]]))


def test_only_log_a_and_log_o_need_the_guard():
    assert [name for name in REWARDS if needs_guard(name)] == [
        "log A",
        "-log O",
        "log A+log U+log M-log O",
        "U+log(A/O)",
    ]
    assert needs_guard({"log O": 0.5})
    assert not needs_guard({"log U": 1.0, "A": 2.0})

"""Settings of the DQN that are off by default, each against NumPy or a small exact example."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.agents.test_dqn import huber, random_batch, train
from tests.populations import differs, make_agent, stack, take
from uavmec_jax.agents import dqn
from uavmec_jax.agents.dqn import DQNHyper, DQNSpec

SPEC = DQNSpec(total_steps=400)


@pytest.fixture(scope="module")
def plain():
    """A plain agent and a second one after 100 iterations."""
    return train(SPEC, stack([make_agent(0), make_agent(1)]), 0, 100)


def weights_of(spec, *seeds):
    """Initial weights of agents with these seeds."""
    return [dqn.init(spec, make_agent(seed)).weights for seed in seeds]


@pytest.mark.parametrize(
    ("steps_done", "expected"),
    [(4, 0.01), (204, 0.01 * (1 - 0.5 * 0.75)), (400, 0.01 * (1 - 0.99 * 0.75))],  # iterations 0, 50 and 99 of 100
)
def test_learning_rate_falls_linearly_to_its_final_share(steps_done, expected):
    hyper = DQNHyper(learning_rate=0.01, learning_rate_final=0.25)
    assert_allclose(dqn.learning_rate(SPEC, hyper, steps_done), expected, rtol=1e-6)
    assert dqn.learning_rate(SPEC, DQNHyper(learning_rate=0.01), steps_done) == 0.01


def test_gradient_step_uses_the_learning_rate_of_its_iteration():
    agent = make_agent(0, learning_rate=0.01, learning_rate_final=0.0, learning_starts=0)
    state, batch = dqn.init(SPEC, agent), random_batch(agent.hyper)
    moved = []
    for steps_done in (4, 304):  # the first learning rate, and a quarter of it
        after = dqn._gradient_step(SPEC, agent.hyper, state, batch, jnp.int32(steps_done))
        bias, before = (np.asarray(tree["params"]["TorchDense_2"]["bias"]) for tree in (after.weights, state.weights))
        t = steps_done // 4  # number of the gradient step; the moments before it are zero
        moved.append(np.abs(bias - before).max() / (0.1 / (1 - 0.9**t) * np.sqrt((1 - 0.999**t) / 0.001)))
    assert_allclose(moved, [0.01, 0.0025], rtol=1e-3)


@pytest.mark.parametrize("double", [False, True])
def test_advantage_learning_subtracts_the_gap_of_the_target_network(double):
    spec, hyper = DQNSpec(advantage_learning=True, double=double), DQNHyper(gap=0.6)
    weights, target = weights_of(spec, 0, 1)
    batch, rows = random_batch(hyper), np.arange(16)
    value, next_online, old, next_values = (
        np.asarray(dqn.q_values(spec, hyper, w, x), float)
        for w, x in (
            (weights, batch.observation),
            (weights, batch.next_observation),
            (target, batch.observation),
            (target, batch.next_observation),
        )
    )
    next_value = next_values[rows, next_online.argmax(1)] if double else next_values.max(1)
    td_target = np.asarray(batch.reward) + (1 - np.asarray(batch.terminated)) * 0.98 * next_value
    td_target -= 0.6 * (old.max(1) - old[rows, batch.action])
    expected = huber(value[rows, batch.action] - td_target).mean()
    assert_allclose(dqn.td_loss(spec, hyper, weights, target, batch), expected, rtol=1e-5)


def test_gap_of_zero_is_plain_learning():
    plain, widened = DQNSpec(), DQNSpec(advantage_learning=True)
    weights, target = weights_of(plain, 0, 1)
    batch = random_batch(DQNHyper())
    losses = [
        float(dqn.td_loss(spec, DQNHyper(gap=gap), weights, target, batch))
        for spec, gap in ((plain, 0.8), (widened, 0.0), (widened, 0.8))
    ]
    assert_allclose(losses[0], losses[1], rtol=1e-6)
    assert abs(losses[0] - losses[2]) > 1e-3


def test_average_follows_the_weights_with_each_gradient_step():
    spec = DQNSpec(total_steps=400, average_weights=True)
    agent = make_agent(0, average_decay=0.7, learning_starts=8)
    state, batch = dqn.init(spec, agent), random_batch(agent.hyper)
    chex.assert_trees_all_equal(state.average, state.weights)
    expected = jax.tree.map(np.asarray, state.weights)
    for steps_done in (4, 8, 12, 16):
        state = dqn._gradient_step(spec, agent.hyper, state, batch, jnp.int32(steps_done))
        if steps_done <= 8:  # the warm-up
            chex.assert_trees_all_equal(state.average, expected)
        else:
            expected = jax.tree.map(lambda old, new: 0.7 * old + 0.3 * np.asarray(new), expected, state.weights)
            assert all(differs(state.average, state.weights))
        chex.assert_trees_all_close(state.average, expected, rtol=1e-6, atol=1e-7)
    assert state.policy_weights is state.average


@pytest.mark.slow
def test_averaging_changes_the_policy_and_nothing_else(plain):
    averaged = train(DQNSpec(total_steps=400, average_weights=True), stack([make_agent(0), make_agent(1)]), 0, 100)
    chex.assert_trees_all_equal(plain.weights, averaged.weights)
    chex.assert_trees_all_equal(plain.buffer_state, averaged.buffer_state)
    assert plain.average is None
    assert plain.policy_weights is plain.weights
    assert all(differs(averaged.policy_weights, averaged.weights))


def test_memory_of_an_agent_counts_the_average():
    size = sum(leaf.size for leaf in jax.tree.leaves(weights_of(SPEC, 0)))
    assert DQNSpec(total_steps=400, average_weights=True).agent_bytes - SPEC.agent_bytes == 4 * size


def actions_of(state, agent=0):
    """The actions in a replay buffer that has not wrapped."""
    return np.asarray(state.buffer_state[agent, 1:, -1]) & 255


def follows_oldest_first(state):
    """Return for each action in a replay buffer whether it is what ``oldest-first`` would have done."""
    previous = np.asarray(state.buffer_state[0, :-1])
    ages = np.stack([(previous[:, 12 + i // 8] >> (4 * (i % 8))) & 15 for i in range(12)], axis=1)
    ages[(previous[:, -1] & 512) > 0] = 0  # a new episode
    return actions_of(state) == ages.argmax(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(("guidance", "expected"), [(1.0, 1.0), (0.5, 0.5 + 0.5 / 12), (0.0, 1 / 12)])
def test_exploration_follows_the_guide_with_the_share_of_guidance(guidance, expected):
    spec = DQNSpec(total_steps=4000, guide="oldest-first")
    agent = make_agent(0, guidance=guidance, learning_starts=4000)  # explores all the time
    share = follows_oldest_first(train(spec, stack([agent]), 0, 1000)).mean()
    assert_allclose(share, expected, atol=0.0 if guidance == 1.0 else 4 * np.sqrt(0.25 / 4000))


@pytest.mark.slow
def test_greedy_actions_do_not_follow_the_guide():
    guided = DQNSpec(total_steps=400, guide="oldest-first")
    hyper = {"learning_starts": 0, "exploration_initial_eps": 0.0, "exploration_final_eps": 0.0, "guidance": 1.0}
    agent = make_agent(0, **hyper)
    state = train(guided, stack([agent]), 0, 1)
    fresh = dqn.init(guided, agent)
    first = dqn.greedy_action(guided, agent.hyper, fresh.weights, jnp.concatenate([jnp.ones(12), jnp.zeros(12)]))
    assert actions_of(state)[0] == first
    assert first != 0  # what the guide would do


@pytest.mark.parametrize(
    ("settings", "numbers"),
    [({}, 14), ({"guide": "oldest-first"}, 15), ({"guide": "oldest-first", "spread_epsilon": True}, 16)],
)
def test_settings_that_are_off_draw_no_random_numbers(settings, numbers):
    assert DQNSpec(**settings).numbers_per_step == numbers


def uniform_numbers(spec, agent):
    """The random numbers of all environment steps, ``[steps, numbers_per_step]``, from the bits themselves."""
    shape, rows = (spec.train_frequency, spec.numbers_per_step), []
    for i in range(spec.iterations):
        bits = jax.random.bits(jax.random.fold_in(agent.key, i), (shape[0] * shape[1] + spec.batch_size,))
        rows.append((np.asarray(bits[: shape[0] * shape[1]]) >> 8).reshape(shape) / 2**24)
    return np.concatenate(rows)


@pytest.mark.slow
def test_every_episode_has_an_epsilon_of_its_own():
    spec = DQNSpec(total_steps=2000, spread_epsilon=True)
    hyper = {"learning_starts": 0, "exploration_initial_eps": 0.8, "exploration_final_eps": 0.8}
    agent = make_agent(0, exploration_spread=0.01, **hyper)
    state, uniform = train(spec, stack([agent]), 0, 500), uniform_numbers(spec, agent)
    ended = (np.asarray(state.buffer_state[0, 1:, -1]) & 512) > 0
    share, shares = 1.0, []
    for numbers, is_end in zip(uniform, ended, strict=True):
        shares.append(share)
        share = 0.01 ** numbers[13] if is_end else share
    assert_allclose(state.epsilon_share[0], share, rtol=1e-5)
    explores, at_random = (
        uniform[:, 12] < 0.8 * np.array(shares),
        actions_of(state) == (uniform[:, -1] * 12).astype(int),
    )
    assert at_random[explores].all()
    assert at_random[~explores].mean() < 0.2  # by chance, 1/12
    assert ended.sum() > 50


@pytest.mark.slow
def test_warm_up_without_a_guide_makes_the_actions_of_the_stream():
    agent = make_agent(0, learning_starts=400)
    state = train(SPEC, stack([agent]), 0, 100)
    assert_array_equal(actions_of(state), (uniform_numbers(SPEC, agent)[:, 13] * 12).astype(int))


def test_layer_norm_normalises_each_hidden_layer_before_its_relu():
    spec = DQNSpec(layer_norm=True)
    weights = weights_of(spec, 0)[0]
    rng = np.random.default_rng(0)
    weights = jax.tree.map(lambda leaf: leaf + jnp.asarray(rng.normal(0, 0.1, leaf.shape), leaf.dtype), weights)
    layers = jax.tree.map(lambda leaf: np.asarray(leaf, float), weights["params"])
    batch = random_batch(DQNHyper())
    x = np.asarray(batch.observation, float)
    for i in range(2):
        x = x @ layers[f"TorchDense_{i}"]["kernel"] + layers[f"TorchDense_{i}"]["bias"]
        x = (x - x.mean(1, keepdims=True)) / np.sqrt(x.var(1, keepdims=True) + 1e-6)
        x = np.maximum(x * layers[f"LayerNorm_{i}"]["scale"] + layers[f"LayerNorm_{i}"]["bias"], 0)
    expected = x @ layers["TorchDense_2"]["kernel"] + layers["TorchDense_2"]["bias"]
    assert_allclose(dqn.q_values(spec, DQNHyper(), weights, batch.observation), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_hyperparameters_of_settings_that_are_off_change_nothing(plain):
    agents = stack([make_agent(0, gap=0.1, guidance=0.9, average_decay=0.2, exploration_spread=0.5), make_agent(1)])
    chex.assert_trees_all_equal(plain, train(SPEC, agents, 0, 100))


@pytest.mark.slow
def test_all_settings_together_train():
    spec = DQNSpec(
        total_steps=4_000, double=True, dueling=True, n_step=10, replay_capacity=1_000, advantage_learning=True,
        layer_norm=True, guide="earliest-deadline", average_weights=True, spread_epsilon=True,
    )  # fmt: skip
    state = train(spec, stack([make_agent(0, learning_rate_final=0.1), make_agent(1)]), 0, 1_000)
    assert (state.diverged_at[:2] == -1).all()
    chex.assert_tree_all_finite(state.policy_weights)
    assert all(differs(take(state.average, 0), take(state.weights, 0)))

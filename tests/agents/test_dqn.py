"""DQN: schedules, one update against NumPy, divergence, variants, and one trace for any population."""

import functools
import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.populations import differs, make_agent, over_agents, stack, take
from uavmec_jax.agents import dqn
from uavmec_jax.agents.dqn import DQNHyper, DQNSpec
from uavmec_jax.agents.replay import Transition

SPEC = DQNSpec(total_steps=20_000)
HYPER = DQNHyper()


@functools.cache
def programs(spec):
    """Jitted ``init`` and ``update`` of a population, compiled once for each number of agents."""
    init, update = (functools.partial(function, spec) for function in (dqn.init, dqn.update))
    return over_agents(init, 0), over_agents(update, 0, 0, None, None)


def train(spec, agents, *bounds, state=None):
    """Train up to four agents, in chunks of iterations between the given bounds."""
    init, update = programs(spec)
    padded = take(agents, np.arange(4) % agents.key.shape[0])
    state = init(padded) if state is None else state
    for first, last in itertools.pairwise(bounds):
        state = update(padded, state, first, last)
    return state


@pytest.mark.parametrize(
    ("steps_done", "expected"),
    # 1,000,000 steps: 1 -> 0.05 over the first 350,000. At 175,000 half-way: 0.525.
    [(0, 1.0), (35_000, 0.905), (175_000, 0.525), (350_000, 0.05), (999_999, 0.05)],
)
def test_epsilon(steps_done, expected):
    assert_allclose(dqn.epsilon(HYPER, 1_000_000, steps_done), expected, rtol=1e-6)


def test_gradient_steps_are_counted_from_step_104():
    spec = DQNSpec()
    assert [int(dqn.gradient_steps(spec, HYPER, steps)) for steps in (4, 96, 100, 104, 108)] == [0, 0, 0, 1, 2]


def test_target_is_due_at_multiples_of_the_interval():
    spec = DQNSpec()
    due = [steps for steps in range(4, 30_001, 4) if dqn.target_is_due(spec, HYPER, steps)]
    assert due == [10_000, 20_000, 30_000]
    odd = DQNHyper(target_interval=10)  # 10 lies in the iteration that ends at 12, 20 in the one that ends at 20
    assert [steps for steps in range(4, 33, 4) if dqn.target_is_due(spec, odd, steps)] == [12, 20, 32]


@pytest.mark.slow
def test_first_gradient_step_falls_at_step_104():
    agents = stack([make_agent(0)])
    before = train(SPEC, agents, 0, 25)  # 100 steps
    fresh = train(SPEC, agents, 0, 0)
    chex.assert_trees_all_equal(before.weights, fresh.weights)
    after = train(SPEC, agents, 25, 26, state=before)
    assert all(differs(before.weights, after.weights))


@pytest.mark.slow
def test_target_is_copied_before_the_gradient_step():
    agents = stack([make_agent(0, target_interval=200)])
    at_196 = train(SPEC, agents, 0, 49)
    chex.assert_trees_all_equal(at_196.target, train(SPEC, agents, 0, 0).weights)
    at_200 = train(SPEC, agents, 49, 50, state=at_196)
    chex.assert_trees_all_equal(at_200.target, at_196.weights)
    assert any(differs(at_200.target, at_200.weights))


@pytest.mark.slow
def test_warm_up_explores_uniformly():
    agents = stack([make_agent(0, learning_starts=20_000, exploration_initial_eps=0.0, exploration_final_eps=0.0)])
    state = train(SPEC, agents, 0, 5_000)
    actions = np.asarray(state.buffer_state[0, 1:, -1]) & 255
    counts = np.bincount(actions, minlength=12)
    assert counts.min() > 1400  # 20,000 / 12 = 1,667, standard deviation 39


def random_batch(hyper, seed=0):
    rng = np.random.default_rng(seed)
    ages = rng.integers(0, 12, (2, 16, 12))
    observation = np.concatenate([rng.random((2, 16, 12)), ages], axis=-1).astype(np.float32)
    return Transition(
        observation=jnp.asarray(observation[0]),
        action=jnp.asarray(rng.integers(0, 12, 16), jnp.int32),
        reward=jnp.asarray(rng.normal(size=16), jnp.float32),
        terminated=jnp.asarray(rng.random(16) < 0.3, jnp.float32),
        next_observation=jnp.asarray(observation[1]),
        discount=jnp.full(16, hyper.gamma),
    )


def numpy_update(weights, target, batch, hyper):
    """One DQN update in NumPy, float64: forward, Huber, backward, clip, Adam's first step."""
    layers = [{k: np.asarray(v, float) for k, v in weights["params"][f"TorchDense_{i}"].items()} for i in range(3)]
    target_layers = [
        {k: np.asarray(v, float) for k, v in target["params"][f"TorchDense_{i}"].items()} for i in range(3)
    ]

    def forward(net, x):
        inputs = []
        for i, layer in enumerate(net):
            inputs.append(x)
            x = x @ layer["kernel"] + layer["bias"]
            x = np.maximum(x, 0) if i < 2 else x
        return x, inputs

    next_value = forward(target_layers, np.asarray(batch.next_observation, float))[0].max(axis=1)
    td_target = np.asarray(batch.reward, float) + (1 - np.asarray(batch.terminated)) * hyper.gamma * next_value
    q, inputs = forward(layers, np.asarray(batch.observation, float))
    rows = np.arange(len(td_target))
    error = q[rows, batch.action] - td_target
    loss = np.where(np.abs(error) < 1, 0.5 * error**2, np.abs(error) - 0.5).mean()
    delta = np.zeros_like(q)
    delta[rows, batch.action] = np.clip(error, -1, 1) / len(td_target)
    gradients = []
    for i in (2, 1, 0):
        gradients.insert(0, {"kernel": inputs[i].T @ delta, "bias": delta.sum(axis=0)})
        delta = (delta @ layers[i]["kernel"].T) * (inputs[i] > 0)
    norm = np.sqrt(sum((g**2).sum() for layer in gradients for g in layer.values()))
    factor = min(hyper.max_grad_norm / (norm + 1e-6), 1.0)
    for layer, gradient in zip(layers, gradients, strict=True):
        for name, g in gradient.items():
            g = g * factor
            m_hat, v_hat = g, g * g  # the first step: bias correction undoes (1 - beta)
            layer[name] = layer[name] - hyper.learning_rate * m_hat / (np.sqrt(v_hat) + 1e-8)
    return loss, layers


@pytest.mark.slow
@pytest.mark.parametrize("max_grad_norm", [10.0, 0.01])
def test_update_against_numpy(jit, max_grad_norm):
    spec, hyper = DQNSpec(), DQNHyper(max_grad_norm=max_grad_norm, learning_starts=0)
    batch = random_batch(hyper)
    agent = make_agent(0)
    state = dqn.init(spec, agent)
    target = jax.tree.map(lambda leaf: leaf * 1.1, state.weights)
    gradient_step = jit(functools.partial(dqn._gradient_step, spec, hyper))
    after = gradient_step(state.replace(target=target), batch, jnp.int32(4))
    loss, layers = numpy_update(state.weights, target, batch, hyper)
    assert_allclose(after.loss, loss, rtol=1e-5)
    for i, layer in enumerate(layers):
        for name, expected in layer.items():
            # Adam's first step is +-lr for any gradient above its epsilon: where the gradient is rounding noise skip it
            assert_allclose(after.weights["params"][f"TorchDense_{i}"][name], expected, rtol=1e-4, atol=2e-5)


@pytest.mark.slow
def test_same_seed_is_bit_equal_and_seeds_differ():
    agents = stack([make_agent(0), make_agent(0), make_agent(1)])
    state, again = train(SPEC, agents, 0, 300), train(SPEC, agents, 0, 300)
    chex.assert_trees_all_equal(state, again)
    kernel = state.weights["params"]["TorchDense_1"]["kernel"]
    assert_array_equal(kernel[0], kernel[1])
    assert (kernel[0] != kernel[2]).any()


@pytest.mark.slow
def test_chunks_do_not_matter():
    agents = stack([make_agent(0), make_agent(1)])
    whole, pieces = train(SPEC, agents, 0, 400), train(SPEC, agents, 0, 7, 150, 400)
    chex.assert_trees_all_equal((whole.weights, whole.buffer_state), (pieces.weights, pieces.buffer_state))


@pytest.mark.slow
@pytest.mark.bits
def test_batched_agent_is_the_agent_alone():
    hypers = [{}, {"gamma": 0.9}, {"learning_rate": 1e-3, "target_interval": 500}, {"learning_starts": 400}]
    agents = [make_agent(i, powered=4 + 2 * i, **hyper) for i, hyper in enumerate(hypers)]
    together = train(SPEC, stack(agents), 0, 250)
    for i, agent in enumerate(agents):
        init, update = programs(SPEC)  # train() would pad
        population = stack([agent])
        alone = update(population, init(population), 0, 250)
        assert_array_equal(alone.buffer_state[0, :, -1], together.buffer_state[i, :, -1])  # the same actions and ends
        chex.assert_trees_all_close(take(alone.weights, 0), take(together.weights, i), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("bad", "step"),  # at 1e30 the first step is still finite
    [
        ({"learning_rate": np.inf}, 104),
        ({"learning_rate": np.nan}, 104),
        ({"gamma": np.nan}, 104),
        ({"learning_rate": 1e30}, 108),
        ({"learning_rate": 1e35}, 104),
    ],
)
def test_diverged_agent_is_frozen_and_does_not_affect_the_others(bad, step):
    stable = [make_agent(0), make_agent(1), make_agent(2)]
    state = train(SPEC, stack([stable[0], make_agent(1, **bad), stable[2]]), 0, 200)
    without = train(SPEC, stack(stable), 0, 200)
    assert_array_equal(state.diverged_at[:3], [-1, step, -1])
    chex.assert_tree_all_finite(state.weights)
    for i in (0, 2):
        chex.assert_trees_all_equal(take(state.weights, i), take(without.weights, i))
    if step == 104:  # not one update was made
        fresh = train(SPEC, stack(stable), 0, 0)
        chex.assert_trees_all_equal(take(state.weights, 1), take(fresh.weights, 1))


def test_loss_that_overflows_freezes_later():
    # The learning rate is legal, the weights grow until the loss overflows: marked after the first updates, still finite.
    state = train(SPEC, stack([make_agent(0, learning_rate=1e25), make_agent(1)]), 0, 200)
    assert state.diverged_at[0] > 104
    assert state.diverged_at[1] == -1
    chex.assert_tree_all_finite(state.weights)


def test_frozen_agent_stays_as_it_was():
    agents = stack([make_agent(0, gamma=np.nan)])
    early = train(SPEC, agents, 0, 30)
    late = train(SPEC, agents, 30, 100, state=early)
    assert early.diverged_at[0] == late.diverged_at[0] == 104
    chex.assert_trees_all_equal(early.weights, late.weights)


def huber(error):
    return np.where(np.abs(error) < 1, 0.5 * error**2, np.abs(error) - 0.5)


def test_double_lets_the_online_network_select_the_next_action():
    plain, double = DQNSpec(), DQNSpec(double=True)
    weights, target = (dqn.init(plain, make_agent(seed)).weights for seed in (0, 1))
    batch = random_batch(HYPER)
    online, delayed = (np.asarray(dqn.q_values(plain, HYPER, w, batch.next_observation)) for w in (weights, target))
    value = np.asarray(dqn.q_values(plain, HYPER, weights, batch.observation))[np.arange(16), batch.action]
    for spec, next_value in ((plain, delayed.max(axis=1)), (double, delayed[np.arange(16), online.argmax(axis=1)])):
        td_target = np.asarray(batch.reward) + (1 - np.asarray(batch.terminated)) * 0.98 * next_value
        assert_allclose(dqn.td_loss(spec, HYPER, weights, target, batch), huber(value - td_target).mean(), rtol=1e-5)
    assert (online.argmax(axis=1) != delayed.argmax(axis=1)).any()


def test_dueling_values_have_advantages_of_mean_zero():
    spec = DQNSpec(dueling=True)
    weights = dqn.init(spec, make_agent(0)).weights
    batch = random_batch(HYPER)
    x = np.asarray(batch.observation, float)
    layers = weights["params"]
    dense = lambda name, x: x @ np.asarray(layers[name]["kernel"], float) + np.asarray(layers[name]["bias"])  # noqa: E731
    for name in ("TorchDense_0", "TorchDense_1"):
        x = np.maximum(dense(name, x), 0)
    advantage, value = dense("TorchDense_2", x), dense("TorchDense_3", x)
    expected = value + advantage - advantage.mean(axis=1, keepdims=True)
    assert_allclose(dqn.q_values(spec, HYPER, weights, batch.observation), expected, rtol=1e-4, atol=1e-5)


def test_soft_update_of_the_target():
    weights, target = (dqn.init(SPEC, make_agent(seed)).weights for seed in (0, 1))
    leaf = lambda tree: np.asarray(tree["params"]["TorchDense_1"]["kernel"])  # noqa: E731
    mixed = dqn.update_target(jnp.asarray(True), 0.25, weights, target)
    assert_allclose(leaf(mixed), 0.25 * leaf(weights) + 0.75 * leaf(target), rtol=1e-6)
    chex.assert_trees_all_equal(dqn.update_target(jnp.asarray(True), 1.0, weights, target), weights)
    chex.assert_trees_all_equal(dqn.update_target(jnp.asarray(False), 0.25, weights, target), target)


@pytest.mark.slow
def test_all_variants_together_train():
    spec = DQNSpec(total_steps=4_000, double=True, dueling=True, n_step=3, replay_capacity=1_000)
    state = train(spec, stack([make_agent(0, tau=0.01, target_interval=4), make_agent(1)]), 0, 1_000)
    assert (state.diverged_at[:2] == -1).all()
    assert all(differs(state.target, state.weights))
    chex.assert_tree_all_finite(state.weights)

"""PQN: its samples, averaged weights, learning rate, drawn scenarios, learning.

test_actor_critic.py has the tests that it shares with PPO and A2C, test_pqn_parity.py compares it with its authors' code.
"""

import functools
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.populations import differs, make_agent, over_agents, stack, take
from uavmec_jax.agents import pqn
from uavmec_jax.agents.exploration import spread_epsilons
from uavmec_jax.env.dynamics import Cause, initial_state
from uavmec_jax.env.observation import observe
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import rollouts
from uavmec_jax.env.scenario import advance, draw_volumes, is_truncated
from uavmec_jax.planning.heuristics import HEURISTICS

make = functools.partial(make_agent, hyper_class=pqn.PQNHyper)
SMALL = pqn.PQNSpec(total_steps=256, hidden=(8,), n_envs=4, n_steps=8, batch_size=8, n_epochs=2)
"""Eight iterations of eight gradient steps."""


def played(spec, agent, seed=5):
    """Return the weights of a new agent, the random numbers of a rollout, its samples, and the state after it."""
    state, key = pqn.init(spec, agent), jax.random.key(seed)
    collect = over_agents(functools.partial(pqn.collect_samples, spec), 0, 0, 0)
    after, samples = take(collect(*stack([(agent, state, key)])), 0)
    bits = jax.random.bits(key, (spec.n_steps, spec.n_envs, spec.n_devices + 3))
    uniform = np.asarray(bits >> 8).astype(np.float32) * 2.0**-24
    samples = jax.tree.map(lambda leaf: leaf.reshape(spec.n_steps, spec.n_envs, *leaf.shape[1:]), samples)
    return state.weights, uniform, samples, after


def test_one_step_targets_are_those_of_a_replay():
    """Replay a rollout slot by slot: a time limit's state is bootstrapped, a failure's is not."""
    spec = replace(SMALL, n_envs=2, n_steps=60, guide="none")
    hyper = {"exploration_highest_eps": 1.0, "exploration_lowest_eps": 1.0, "q_lambda": 0.0, "gap": 0.0, "gamma": 0.5}
    agent = make(0, params=Params(max_slots=12), connected=10, **hyper)
    weights, uniform, samples, after = played(spec, agent)
    params, layout = agent.scenario.params, agent.scenario.layout
    slot = jax.jit(functools.partial(advance, agent.scenario))
    value = jax.jit(lambda state: pqn.q_values(spec, agent.hyper, weights, observe(params, layout, state)[None])[0])
    causes = []
    for env in range(2):
        state = initial_state(params, layout)
        for t in range(60):
            assert_allclose(samples.observation[t, env], observe(params, layout, state), rtol=1e-5)
            state, reward, outcome = slot(
                state, samples.action[t, env], draw_volumes(params, jnp.asarray(uniform[t, env, :12]))
            )
            terminated, truncated = outcome.cause != Cause.NONE, is_truncated(agent.scenario, state, outcome)
            target = reward + (0.0 if terminated else 0.5 * value(state).max())
            assert_allclose(samples.target[t, env], target, rtol=1e-4)
            causes.append((bool(terminated), bool(truncated)))
            if terminated or truncated:
                state = initial_state(params, layout)
    assert {(True, False), (False, True), (False, False)} == set(causes)
    assert after.episodes == sum(map(any, causes))


def test_actions_are_greedy_but_for_the_shares_epsilon():
    spec = replace(SMALL, n_envs=3, n_steps=400, guide="none")
    agent = make(0, exploration_highest_eps=0.8, exploration_lowest_eps=0.05)
    weights, uniform, samples, _ = played(spec, agent)
    values = pqn.q_values(spec, agent.hyper, weights, samples.observation.reshape(-1, 24)).reshape(400, 3, 12)
    greedy = np.asarray(values.argmax(axis=-1) == samples.action)
    explores = uniform[:, :, 12] < np.asarray(spread_epsilons(0.8, 0.05, 3))
    assert greedy[~explores].all()
    assert_allclose(explores.mean(axis=0), [0.8, 0.2, 0.05], atol=0.06)
    assert greedy[explores].mean() < 0.25  # one of twelve devices by chance


def test_traces_are_cut_at_exploratory_actions():
    """Of two environments that explore in every slot or never, only the first one's targets depend on the cut."""
    spec = replace(SMALL, n_envs=2, n_steps=20, guide="none")
    agent = make(0, exploration_highest_eps=1.0, exploration_lowest_eps=1e-6, q_lambda=1.0, gap=0.0)
    cut, uncut = (played(replace(spec, cut_traces=cuts), agent)[2] for cuts in (True, False))
    assert_array_equal(cut.action, uncut.action)
    assert_array_equal(cut.target[:, 1], uncut.target[:, 1])
    assert (cut.target[:, 0] != uncut.target[:, 0]).mean() > 0.5
    assert cut.target[-1, 0] == uncut.target[-1, 0]


def test_the_gap_lowers_the_targets_of_other_actions():
    plain, wide = (played(SMALL, make(0, gap=gap)) for gap in (0.0, 0.5))
    weights, samples = wide[0], wide[2]
    values = pqn.q_values(SMALL, make().hyper, weights, samples.observation.reshape(-1, 24)).reshape(8, 4, 12)
    taken = jnp.take_along_axis(values, samples.action[..., None], axis=-1)[..., 0]
    assert_allclose(plain[2].target - samples.target, 0.5 * (values.max(axis=-1) - taken), rtol=1e-3, atol=1e-4)


@functools.cache
def update_of(spec):
    return over_agents(functools.partial(pqn.update, spec), 0, 0, None, None)


@pytest.mark.parametrize("average_weights", [True, False])
def test_policies_act_by_averaged_weights(average_weights):
    spec = replace(SMALL, average_weights=average_weights)
    agents = stack([make(0, average_decay=0.6), make(1, average_decay=0.9)])
    state = over_agents(functools.partial(pqn.init, spec), 0)(agents)
    chex.assert_trees_all_equal(state.policy_weights, state.weights)
    decay, average = np.array([0.6, 0.9], np.float32), state.weights

    def mean(old, new):
        keep = decay.reshape(-1, *(1,) * (old.ndim - 1))
        return keep * old + (1 - keep) * new

    for i in range(3):
        state = update_of(spec)(agents, state, i, i + 1)
        average = jax.tree.map(mean, average, state.weights)
        chex.assert_trees_all_close(
            state.policy_weights, average if average_weights else state.weights, rtol=1e-5, atol=1e-6
        )
    assert all(differs(state.policy_weights, state.weights)) == average_weights
    assert (state.average is None) != average_weights


@pytest.mark.parametrize("final", [0.0, 0.25, 1.0])
def test_the_learning_rate_falls_linearly(monkeypatch, final):
    seen, apply_gradients = {}, pqn.apply_gradients

    def recorded(*arguments, learning_rate, count, steps_done, **named):
        jax.debug.callback(
            lambda *numbers: seen.update({int(numbers[0]): (float(numbers[1]), int(numbers[2]))}),
            *(count, learning_rate, steps_done),
        )
        return apply_gradients(*arguments, learning_rate=learning_rate, count=count, steps_done=steps_done, **named)

    monkeypatch.setattr(pqn, "apply_gradients", recorded)
    agents = stack([make(0, learning_rate=0.01, learning_rate_final=final)])
    state = over_agents(functools.partial(pqn.init, SMALL), 0)(agents)
    update = over_agents(functools.partial(pqn.update, SMALL), 0, 0, None, None)
    update(agents, update(agents, state, 0, 3), 3, 8)
    jax.effects_barrier()
    assert sorted(seen) == list(range(1, 65))
    rates, steps = np.array([seen[count] for count in range(1, 65)]).T
    assert_allclose(rates, 0.01 * (1 - (1 - final) * np.arange(64) / 64), rtol=1e-5)
    assert_array_equal(steps, np.repeat(32 * np.arange(1, 9), 8))  # environment steps when the gradient step is made


def test_a_shuffle_has_every_sample_once():
    spec, agent = SMALL, make(0)
    weights, _, samples, _ = played(spec, agent)
    rows = pqn._rows(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), samples))
    order = pqn.permutation(jax.random.key(1), rows.shape[0])
    assert_array_equal(np.sort(order), np.arange(32))
    assert (np.asarray(order) != np.arange(32)).any()
    unpacked = pqn._samples(rows[order])
    for ours, packed in zip(unpacked, samples, strict=True):
        assert_array_equal(ours, packed.reshape(32, *packed.shape[2:])[order])
    parts = [pqn._samples(part) for part in rows[order].reshape(4, 8, -1)]
    losses = [pqn.pqn_loss(spec, agent.hyper, weights, part) for part in parts]
    assert_allclose(np.mean(losses), pqn.pqn_loss(spec, agent.hyper, weights, unpacked), rtol=1e-5)


def test_minibatch_must_divide_the_rollout():
    with pytest.raises(ValueError, match=r"^batch_size is 48; it should divide n_steps \* n_envs = 64$"):
        pqn.algorithm(pqn.PQNSpec(n_steps=16, n_envs=4, batch_size=48))


def test_greedy_action_takes_any_batch_of_observations():
    algorithm, hyper = pqn.algorithm(SMALL), pqn.PQNHyper()
    weights = algorithm.init(make()).policy_weights
    observations = jax.random.uniform(jax.random.key(0), (2, 5, 24))
    actions = algorithm.greedy(hyper, weights, observations)
    chex.assert_shape(actions, (2, 5))
    assert actions[1, 3] == algorithm.greedy(hyper, weights, observations[1, 3])
    values = pqn.q_values(SMALL, hyper, weights, observations[1])
    assert_array_equal(actions[1], values.argmax(axis=-1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("observation", "hidden", "steps", "n_envs", "n_steps"),
    [("full", (32, 32), 8_192, 16, 16), ("paper", (64, 64), 65_536, 64, 32)],
)
def test_learns_to_beat_random_by_far(observation, hidden, steps, n_envs, n_steps):
    """12 powered, 8 connected: the random policy lives about 11 slots, oldest-first 29. Exploration has no guide here."""
    spec = pqn.PQNSpec(steps, hidden, observation, n_envs=n_envs, n_steps=n_steps, guide="none")
    algorithm = pqn.algorithm(spec)
    agents = stack([make(i, powered=12, connected=8) for i in range(4)])
    state = over_agents(algorithm.init, 0)(agents)
    state = over_agents(algorithm.update, 0, 0, None, None)(agents, state, 0, algorithm.iterations)
    assert_array_equal(state.diverged_at, -1)

    def lifetimes(agent, weights, keys):
        params, layout = agent.scenario.params, agent.scenario.layout
        policies = (algorithm.policy(agent.hyper, weights), HEURISTICS["random"])
        return [rollouts(policy, params, layout, keys).length.mean() for policy in policies]

    keys = jax.random.split(jax.random.key(77), (4, 16))
    learned, random = jax.jit(jax.vmap(lifetimes))(agents, state.policy_weights, keys)
    assert learned.mean() > 1.6 * random.mean()

"""PPO and A2C: rollouts, independence of agents, divergence, learning. test_parity.py compares their updates with SB3's.

Independence and divergence are tested for PQN, too; its other tests are in test_pqn.py.
"""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from tests.populations import differs, make_agent, over_agents, stack, take
from uavmec_jax.agents import a2c, actor_critic, gae, ppo, pqn
from uavmec_jax.agents.collect_rollout import collect_rollout
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.observation import observe
from uavmec_jax.env.params import Params

A2C = a2c.algorithm(a2c.A2CSpec(total_steps=10_000))
PPO = ppo.algorithm(ppo.PPOSpec(total_steps=10_000, n_steps=64, batch_size=16, n_epochs=2))
PQN = pqn.algorithm(pqn.PQNSpec(total_steps=10_000, hidden=(16,), n_envs=4, n_steps=16, batch_size=16, n_epochs=2))
ALGORITHMS = {"a2c": (A2C, a2c.A2CHyper), "ppo": (PPO, ppo.PPOHyper), "pqn": (PQN, pqn.PQNHyper)}


@functools.cache
def programs(name):
    algorithm, _ = ALGORITHMS[name]
    return over_agents(algorithm.init, 0), over_agents(algorithm.update, 0, 0, None, None)


def train(name, agents, first, last, state=None):
    """Train a population of three for some iterations."""
    init, update = programs(name)
    return update(agents, init(agents) if state is None else state, first, last)


def population(name, *hypers):
    return stack([make_agent(i, hyper_class=ALGORITHMS[name][1], **hyper) for i, hyper in enumerate(hypers)])


def test_actions_are_sampled_from_the_softmax(jit):
    sample_action = jit(gae.sample_action)
    logits = jnp.tile(jnp.log(jnp.array([[0.5, 0.2, 0.0, 0.3]])), (20_000, 1))
    actions = np.asarray(sample_action(logits, jax.random.uniform(jax.random.key(0), (20_000,))))
    counts = np.bincount(actions, minlength=4)
    assert counts[2] == 0
    assert stats.chisquare(counts[[0, 1, 3]], [10_000, 4_000, 6_000]).pvalue > 1e-3
    edges = sample_action(logits[:2], jnp.array([0.0, 1.0 - 2.0**-24]))
    assert_array_equal(edges, [0, 3])


@pytest.mark.slow
def test_a_rollout_plays_the_environment():
    spec = a2c.A2CSpec(n_steps=40, n_envs=3)
    agent = make_agent(0, hyper_class=a2c.A2CHyper)
    state = actor_critic.init(spec, a2c._OPTIMIZER, agent)
    collect = over_agents(functools.partial(collect_rollout, spec), 0, 0, 0)
    after, samples = take(collect(*stack([(agent, state, jax.random.key(5))])), 0)
    observation = samples.observation.reshape(40, 3, 24)
    params, layout = agent.scenario.params, agent.scenario.layout
    fresh = observe(params, layout, initial_state(params, layout))
    starts = np.isclose(observation, fresh, atol=1e-6).all(axis=-1)  # XLA multiplies by the reciprocal capacity
    assert starts[0].all()
    assert starts[1:].sum() == after.episodes  # an episode that ended begins again in the next slot
    assert (np.asarray(observation[1, 0]) != np.asarray(observation[1, 1])).any()  # environments differ
    assert samples.action.min() >= 0
    assert len(set(np.asarray(samples.action).tolist())) == 12
    lengths = np.diff(np.flatnonzero(np.append(starts[:, 0], True)))
    assert 1 <= after.env_states.slot.min() <= after.env_states.slot.max() <= 33
    assert (lengths[:-1] > 5).all()


@pytest.mark.slow
def test_a_cut_off_episode_is_bootstrapped():
    """With a time limit of one slot, every reward includes the discounted value of the state it was cut off in."""
    spec = a2c.A2CSpec(n_steps=4)
    hyper = {"gamma": 0.5, "gae_lambda": 1.0}
    limited, free = (
        make_agent(0, params=Params(max_slots=limit), hyper_class=a2c.A2CHyper, **hyper) for limit in (1, 1000)
    )
    state = actor_critic.init(spec, a2c._OPTIMIZER, limited)
    collect = over_agents(functools.partial(collect_rollout, spec), 0, 0, 0)
    _, truncated = take(collect(*stack([(limited, state, jax.random.key(5))])), 0)
    _, full = take(collect(*stack([(free, state, jax.random.key(5))])), 0)
    # the first slot is the same for both; the state it led to is what the free one observes next
    values = np.asarray(actor_critic.value(spec, limited.hyper, state.weights, full.observation[:2]))
    assert_array_equal(truncated.observation[0], full.observation[0])
    # returns: r + gamma V(s') when truncated; r + gamma (second slot's return) when free
    difference = full.returns[0] - truncated.returns[0]
    assert_allclose(difference, 0.5 * (full.returns[1] - values[1]), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.bits
@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_agent_does_not_depend_on_the_others(name):
    agents = population(name, {}, {"gamma": 0.9}, {"learning_rate": 1e-3})
    state, again = train(name, agents, 0, 12), train(name, agents, 0, 12)
    chex.assert_trees_all_equal(state, again)
    pieces = train(name, agents, 5, 12, train(name, agents, 0, 5))
    chex.assert_trees_all_equal(state.weights, pieces.weights)
    others = population(name, {}, {"gamma": 0.5}, {"learning_rate": 1e-2})
    mixed = train(name, others, 0, 12)
    chex.assert_trees_all_equal(take(state.weights, 0), take(mixed.weights, 0))
    assert any(differs(take(state, 1), take(mixed, 1)))


@pytest.mark.slow
@pytest.mark.bits
@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_agent_does_not_depend_on_its_place(name):
    agents = population(name, {}, {"gamma": 0.9}, {"learning_rate": 1e-3})
    order = np.array([2, 0, 1])
    moved = train(name, take(agents, order), 0, 12)
    chex.assert_trees_all_equal(take(train(name, agents, 0, 12), order), moved)


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.slow
@pytest.mark.parametrize("bad", [{"learning_rate": np.inf}, {"gamma": np.nan}])
def test_diverged_agent_is_frozen_and_does_not_affect_the_others(name, bad):
    state = train(name, population(name, {}, bad, {}), 0, 12)
    stable = train(name, population(name, {}, {}, {}), 0, 12)
    steps = ALGORITHMS[name][0].steps_per_iteration
    assert_array_equal(state.diverged_at, [-1, steps, -1])
    chex.assert_tree_all_finite(state.weights)
    for i in (0, 2):
        chex.assert_trees_all_equal(take(state.weights, i), take(stable.weights, i))


def test_advantage_of_one_sample_stays_as_it_is():
    assert_array_equal(gae.normalize(jnp.array([3.0]), True), [3.0])
    advantages = jnp.array([1.0, 2.0, 6.0])
    assert_array_equal(gae.normalize(advantages, False), advantages)
    assert_allclose(gae.normalize(advantages, True), (advantages - 3) / np.std([1, 2, 6], ddof=1), rtol=1e-5)


def test_minibatch_must_divide_the_rollout():
    with pytest.raises(ValueError, match=r"batch_size is 48; it should divide n_steps \* n_envs = 64"):
        ppo.algorithm(ppo.PPOSpec(n_steps=64, batch_size=48))


def test_greedy_action_takes_any_batch_of_observations():
    weights = PPO.init(make_agent(0, hyper_class=ppo.PPOHyper)).weights
    observations = jax.random.uniform(jax.random.key(0), (2, 5, 24))
    actions = PPO.greedy(ppo.PPOHyper(), weights, observations)
    chex.assert_shape(actions, (2, 5))
    assert actions[1, 3] == PPO.greedy(ppo.PPOHyper(), weights, observations[1, 3])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a2c", "ppo"])
def test_learns_to_visit_the_oldest(name):
    """On a layout where only data age matters, episodes are much longer after a hundred thousand steps."""
    hyper_class = ALGORITHMS[name][1]
    spec = {"a2c": a2c.A2CSpec, "ppo": ppo.PPOSpec}[name](total_steps=100_000)
    algorithm = {"a2c": a2c.algorithm, "ppo": ppo.algorithm}[name](spec)
    agents = stack([make_agent(i, powered=12, connected=4, hyper_class=hyper_class, age_scale=0.1) for i in range(4)])
    update = over_agents(algorithm.update, 0, 0, None, None)
    state = over_agents(algorithm.init, 0)(agents)
    early = update(agents, state, 0, max(algorithm.iterations // 20, 1))
    late = update(agents, early, max(algorithm.iterations // 20, 1), algorithm.iterations)
    final = update(agents, late, algorithm.iterations, algorithm.iterations + max(algorithm.iterations // 20, 1))
    length = lambda state: float(state.episode_slots.sum() / state.episodes.sum())  # noqa: E731
    assert length(final) > length(early) + 1.5

"""PPO and A2C: what a rollout is, what an agent may not do. Their updates are held against SB3 in test_parity.py."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from tests.populations import make_agent, stack, take
from uavmec_jax.agents import a2c, on_policy, ppo
from uavmec_jax.agents import collect_rollout as experience
from uavmec_jax.agents import gae as estimates
from uavmec_jax.agents.algorithm import AGENTS_AXIS
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.observation import observe
from uavmec_jax.env.params import Params

A2C = a2c.algorithm(a2c.A2CSpec(total_steps=10_000))
PPO = ppo.algorithm(ppo.PPOSpec(total_steps=10_000, n_steps=64, batch_size=16, n_epochs=2))
BOTH = ["a2c", pytest.param("ppo", marks=pytest.mark.slow)]
KINDS = {"a2c": (A2C, a2c.A2CHyper), "ppo": (PPO, ppo.PPOHyper)}


@functools.cache
def programs(name):
    algorithm, _ = KINDS[name]
    over = lambda f, *axes: jax.jit(jax.vmap(f, axes, axis_name=AGENTS_AXIS))  # noqa: E731
    return over(algorithm.init, 0), over(algorithm.update, 0, 0, None, None)


def train(name, agents, first, last, state=None):
    """A population of three through some iterations."""
    init, update = programs(name)
    return update(agents, init(agents) if state is None else state, first, last)


def population(name, *hypers):
    return stack([make_agent(i, kind=KINDS[name][1], **hyper) for i, hyper in enumerate(hypers)])


def test_actions_are_drawn_from_the_softmax():
    scores = jnp.tile(jnp.log(jnp.array([[0.5, 0.2, 0.0, 0.3]])), (20_000, 1))
    actions = np.asarray(estimates.sample_action(scores, jax.random.uniform(jax.random.key(0), (20_000,))))
    counts = np.bincount(actions, minlength=4)
    assert counts[2] == 0
    assert stats.chisquare(counts[[0, 1, 3]], [10_000, 4_000, 6_000]).pvalue > 1e-3
    edges = estimates.sample_action(scores[:2], jnp.array([0.0, 1.0 - 2.0**-24]))
    assert_array_equal(edges, [0, 3])


@pytest.mark.slow
def test_a_rollout_plays_the_environment():
    spec = a2c.A2CSpec(n_steps=40, n_envs=3)
    agent = make_agent(0, kind=a2c.A2CHyper)
    state = on_policy.init(spec, a2c._OPTIMIZER, agent)
    play = jax.jit(jax.vmap(functools.partial(experience.play, spec), axis_name=AGENTS_AXIS))
    after, samples = take(play(*stack([(agent, state, jax.random.key(5))])), 0)
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
    assert 1 <= after.worlds.slot.min() <= after.worlds.slot.max() <= 33
    assert (lengths[:-1] > 5).all()


@pytest.mark.slow
def test_a_cut_off_episode_is_bootstrapped():
    """With a time limit of one slot every reward holds the discounted value of the state that was cut off."""
    spec = a2c.A2CSpec(n_steps=4)
    weighty = {"gamma": 0.5, "gae_lambda": 1.0}
    limited, free = (make_agent(0, params=Params(max_slots=limit), kind=a2c.A2CHyper, **weighty) for limit in (1, 1000))
    state = on_policy.init(spec, a2c._OPTIMIZER, limited)
    play = jax.jit(jax.vmap(functools.partial(experience.play, spec), axis_name=AGENTS_AXIS))
    _, cut = take(play(*stack([(limited, state, jax.random.key(5))])), 0)
    _, whole = take(play(*stack([(free, state, jax.random.key(5))])), 0)
    # the first slot is the same for both; what it led to is what the free one sees next
    reward_and_value = np.asarray(on_policy.value(spec, limited.hyper, state.weights, whole.observation[:2]))
    assert_array_equal(cut.observation[0], whole.observation[0])
    # returns: r + gamma V(s') when cut; r + gamma (second slot's return) when free
    difference = whole.returns[0] - cut.returns[0]
    assert_allclose(difference, 0.5 * (whole.returns[1] - reward_and_value[1]), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.bits
@pytest.mark.parametrize("name", BOTH)
def test_an_agent_is_itself_whoever_trains_beside_it(name):
    agents = population(name, {}, {"gamma": 0.9}, {"learning_rate": 1e-3})
    state, again = train(name, agents, 0, 12), train(name, agents, 0, 12)
    jax.tree.map(assert_array_equal, state, again)
    pieces = train(name, agents, 5, 12, train(name, agents, 0, 5))
    jax.tree.map(assert_array_equal, state.weights, pieces.weights)
    others = population(name, {}, {"gamma": 0.5}, {"learning_rate": 1e-2})
    mixed = train(name, others, 0, 12)
    jax.tree.map(lambda a, b: assert_array_equal(a[0], b[0]), state.weights, mixed.weights)
    assert any((a[1] != b[1]).any() for a, b in zip(*map(jax.tree.leaves, (state, mixed)), strict=True))


@pytest.mark.parametrize("name", BOTH)
@pytest.mark.slow
@pytest.mark.parametrize("bad", [{"learning_rate": np.inf}, {"gamma": np.nan}])
def test_diverged_agent_is_frozen_marked_and_touches_nobody(name, bad):
    state = train(name, population(name, {}, bad, {}), 0, 12)
    sound = train(name, population(name, {}, {}, {}), 0, 12)
    steps = KINDS[name][0].steps_per_iteration
    assert_array_equal(state.diverged_at, [-1, steps, -1])
    for leaf, other in zip(*map(jax.tree.leaves, (state.weights, sound.weights)), strict=True):
        assert np.isfinite(leaf).all()
        assert_array_equal(leaf[jnp.array([0, 2])], other[jnp.array([0, 2])])


def test_advantage_of_one_sample_stays_as_it_is():
    assert_array_equal(estimates.normalized(jnp.array([3.0]), True), [3.0])
    values = jnp.array([1.0, 2.0, 6.0])
    assert_array_equal(estimates.normalized(values, False), values)
    assert_allclose(estimates.normalized(values, True), (values - 3) / np.std([1, 2, 6], ddof=1), rtol=1e-5)


def test_minibatch_must_divide_the_rollout():
    with pytest.raises(ValueError, match=r"batch_size is 48; it should divide n_steps \* n_envs = 64"):
        ppo.algorithm(ppo.PPOSpec(n_steps=64, batch_size=48))


def test_greedy_takes_any_batch_of_observations():
    weights = PPO.init(make_agent(0, kind=ppo.PPOHyper)).weights
    observations = jax.random.uniform(jax.random.key(0), (2, 5, 24))
    chosen = PPO.greedy(ppo.PPOHyper(), weights, observations)
    assert chosen.shape == (2, 5)
    assert chosen[1, 3] == PPO.greedy(ppo.PPOHyper(), weights, observations[1, 3])


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_learns_to_visit_the_oldest(name):
    """On a layout where only data age matters, a hundred thousand steps must beat chance by far."""
    kind = KINDS[name][1]
    spec = {"a2c": a2c.A2CSpec, "ppo": ppo.PPOSpec}[name](total_steps=100_000)
    algorithm = {"a2c": a2c.algorithm, "ppo": ppo.algorithm}[name](spec)
    agents = stack([make_agent(i, powered=12, connected=4, kind=kind, age_scale=0.1) for i in range(4)])
    update = jax.jit(jax.vmap(algorithm.update, (0, 0, None, None), axis_name=AGENTS_AXIS))
    state = jax.jit(jax.vmap(algorithm.init))(agents)
    early = update(agents, state, 0, max(algorithm.iterations // 20, 1))
    late = update(agents, early, max(algorithm.iterations // 20, 1), algorithm.iterations)
    final = update(agents, late, algorithm.iterations, algorithm.iterations + max(algorithm.iterations // 20, 1))
    length = lambda state: float(state.episode_slots.sum() / state.episodes.sum())  # noqa: E731
    assert length(final) > length(early) + 1.5

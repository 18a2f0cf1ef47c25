"""The population: blocks, looks, curves, devices, learning."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.populations import make_agent, stack
from uavmec_jax.agents import dqn
from uavmec_jax.agents.dqn import DQNSpec
from uavmec_jax.env.layout import Traffic, sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import make_reward
from uavmec_jax.env.rollout import rollouts
from uavmec_jax.env.scenario import make_scenario
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.training import population
from uavmec_jax.training.partition import Partition, PopulationTooLargeError, partition_population
from uavmec_jax.training.programs import Best, _validate
from uavmec_jax.training.training import Validation

GIB = 2**30


def train(agents, steps=2000, blocks=None, validation=None, **spec):
    algorithm = dqn.algorithm(DQNSpec(total_steps=steps, **spec))
    n = agents.key.shape[0]
    validation = validation or Validation(every=800, draws=4)
    keys = jax.random.split(jax.random.key(9), (n, validation.draws))
    news = []
    trained = list(
        population.train(
            algorithm,
            agents,
            keys,
            validation=validation,
            blocks=blocks or partition_population(n, algorithm.agent_bytes, GIB),
            on_progress=news.append,
        )
    )
    return trained, news


def test_blocks_are_equal_cover_everyone_and_fit():
    assert partition_population(250, 64 * 10**6, 16 * GIB) == Partition(
        count=4, size=64, groups=2, bytes=64 * 64 * 10**6
    )
    assert partition_population(1, 10, GIB) == Partition(count=1, size=1, groups=1, bytes=10)
    for n in (1, 2, 3, 75, 81, 1000):
        for memory in (GIB, 10 * GIB):
            blocks = partition_population(n, 64 * 2**20, memory)
            assert blocks.count * blocks.size >= n
            assert (blocks.count - 1) * blocks.size < n
            assert blocks.bytes <= memory
            assert blocks.size % blocks.groups == 0


def test_too_little_memory_is_said():
    assert partition_population(10, 3 * GIB, 4 * GIB).groups == 1
    with pytest.raises(PopulationTooLargeError, match=r"one agent needs 5.0 GiB and 4.0 GiB are free"):
        partition_population(10, 5 * GIB, 4 * GIB)


@pytest.mark.slow
def test_what_a_block_leaves():
    agents = stack([make_agent(i) for i in range(3)])
    (block,), news = train(agents)
    assert_array_equal(block.validation_steps, [800, 1600, 2000])
    assert block.validation.shape == (3, 3)
    assert block.episode_length.shape == (3, len(block.chunk_steps)) == (3, 12)
    assert block.chunk_steps[-1] == 2000
    assert_array_equal(block.diverged_at, -1)
    assert_array_equal(block.best_score, block.validation.max(axis=1))
    assert_array_equal(block.best_step, block.validation_steps[block.validation.argmax(axis=1)])
    assert news[-1].steps == news[-1].total_steps == 6000
    assert 9 < news[-1].mean_episode_length < 40
    assert set(block.seconds) == {"train", "validate"}


@pytest.mark.slow
def test_best_weights_are_those_of_the_best_look():
    agents = stack([make_agent(i) for i in range(2)])
    (block,), _ = train(agents)
    algorithm = dqn.algorithm(DQNSpec(total_steps=2000))
    keys = jax.random.split(jax.random.key(9), (2, 4))

    def score(agent, weights, draws):
        scenario = agent.scenario
        return rollouts(algorithm.policy(agent.hyper, weights), scenario.params, scenario.layout, draws).length.mean()

    assert_allclose(jax.vmap(score)(agents, block.best, keys), block.best_score, rtol=1e-6)
    assert_allclose(jax.vmap(score)(agents, block.last, keys), block.validation[:, -1], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.bits
def test_blocks_padding_and_devices_do_not_change_an_agent():
    agents = stack([make_agent(i) for i in range(5)])
    (whole,), _ = train(agents, 1000, blocks=Partition(1, 6, 2, 0))
    split, _ = train(agents, 1000, blocks=Partition(2, 4, 2, 0))
    single, _ = train(agents, 1000, blocks=Partition(1, 5, 1, 0))
    assert [len(block.best_step) for block in split] == [4, 1]
    pieces = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(block.last for block in split))
    for other in (pieces, single[0].last):
        jax.tree.map(lambda a, b: assert_allclose(a, b, rtol=1e-2, atol=1e-3), whole.last, other)


@pytest.mark.slow
def test_small_replay_wraps():
    agents = stack([make_agent(0), make_agent(1)])
    (block,), _ = train(agents, replay_capacity=100)
    assert_array_equal(block.diverged_at, -1)
    assert np.isfinite(block.validation).all()


@pytest.mark.slow
def test_odd_train_frequency_and_widths():
    (block,), _ = train(stack([make_agent(0)]), steps=1001, train_frequency=3, hidden=(8,), batch_size=5)
    assert block.chunk_steps[-1] == 1002  # whole iterations
    assert block.last["params"]["TorchDense_0"]["kernel"].shape == (1, 24, 8)


@pytest.mark.slow
def test_dqn_learns_to_beat_random_by_far():
    # 12 powered, 8 connected: random lives about 16 slots, oldest-first 29. On three layouts, best weights of 60,000 steps.
    agents = stack([make_agent(i, powered=12, connected=8) for i in range(4)])
    (block,), _ = train(agents, steps=60_000, validation=Validation(every=5_000, draws=8))
    algorithm = dqn.algorithm(DQNSpec(total_steps=60_000))
    keys = jax.random.split(jax.random.key(77), (4, 16))

    def lifetimes(agent, weights, draws):
        scenario = agent.scenario
        world = (scenario.params, scenario.layout, draws)
        ours = rollouts(algorithm.policy(agent.hyper, weights), *world).length.mean()
        return ours, rollouts(HEURISTICS["random"], *world).length.mean()

    ours, random = jax.vmap(lifetimes)(agents, block.best, keys)
    assert ours.mean() > 1.4 * random.mean()


@pytest.mark.parametrize("paid", [False, True])
def test_the_best_look_is_the_longest_life_or_what_pays_most(paid):
    """Staying at device 1 lives as long as staying at device 2, but device 2 is where the traffic is."""
    scenario = make_scenario(layout=sample_layout(jax.random.key(5), Params(), 12, 12))
    weight = jnp.zeros((1, 12)).at[0, 1].set(1.0)
    reward = make_reward("U", traffic_bonus=2.0 if paid else 0.0)
    scenario = replace(scenario, layout=replace(scenario.layout, traffic=Traffic(weight)), reward=reward)
    stays = replace(dqn.algorithm(DQNSpec(total_steps=200)), greedy=lambda hyper, device, observation: device)
    agent = replace(make_agent(), scenario=scenario)
    best = Best(jnp.int32(7), jnp.float32(-jnp.inf), jnp.int32(0))
    keys = jax.random.split(jax.random.key(0), 2)
    first, best = _validate(stays, agent, keys, jnp.int32(0), best, 10)
    second, best = _validate(stays, agent, keys, jnp.int32(1), best, 20)
    earned = 33 * 34 / 2 + 33  # the slot that the UAV's battery cannot pay for is the 34th decision, with U = 33
    assert first == (earned if paid else 33)
    assert second == (earned + 2 * 34 if paid else 33)
    assert (int(best.weights), int(best.step)) == ((1, 20) if paid else (0, 10))

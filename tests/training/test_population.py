"""The population: partition, validation, curves, learning."""

from dataclasses import replace

import chex
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
from uavmec_jax.training.chunks import Validation
from uavmec_jax.training.partition import Partition, PopulationTooLargeError, partition_population
from uavmec_jax.training.population import train_population
from uavmec_jax.training.programs import Best, _validate

GIB = 2**30


def train(agents, steps=2000, partition=None, validation=None, **spec):
    algorithm = dqn.algorithm(DQNSpec(total_steps=steps, **spec))
    n = agents.key.shape[0]
    validation = validation or Validation(every=800, draws=4)
    keys = jax.random.split(jax.random.key(9), (n, validation.draws))
    partition = partition or partition_population(n, algorithm.agent_bytes, GIB)
    progress = []
    shards = train_population(
        algorithm, agents, keys, validation=validation, partition=partition, on_progress=progress.append
    )
    return list(shards), progress


def test_shards_are_equal_cover_the_population_and_fit(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setattr(jax, "local_device_count", lambda: 2)
    expected = Partition(shards=4, shard_size=64, groups=2, shard_bytes=64 * 64 * 10**6)
    assert partition_population(250, 64 * 10**6, 16 * GIB) == expected
    assert partition_population(1, 10, GIB) == Partition(shards=1, shard_size=1, groups=1, shard_bytes=10)
    assert partition_population(250, 10, GIB, max_shard=7) == Partition(
        shards=42, shard_size=6, groups=2, shard_bytes=60
    )
    for n in (1, 2, 3, 75, 81, 1000):
        for memory in (GIB, 10 * GIB):
            partition = partition_population(n, 64 * 2**20, memory)
            assert partition.shards * partition.shard_size >= n
            assert (partition.shards - 1) * partition.shard_size < n
            assert partition.shard_bytes <= memory
            assert partition.group_size * partition.groups == partition.shard_size
            assert partition.groups % partition.devices == 0


def test_too_little_memory_is_refused():
    assert partition_population(10, 3 * GIB, 4 * GIB).groups == 1
    with pytest.raises(PopulationTooLargeError, match=r"one agent needs 5.0 GiB and 4.0 GiB are free"):
        partition_population(10, 5 * GIB, 4 * GIB)


@pytest.mark.slow
def test_result_of_a_shard():
    agents = stack([make_agent(i) for i in range(3)])
    (shard,), progress = train(agents)
    assert_array_equal(shard.validation_steps, [800, 1600, 2000])
    chex.assert_shape([shard.validation, shard.episode_length, shard.chunk_steps], [(3, 3), (3, 12), (12,)])
    assert shard.chunk_steps[-1] == 2000
    assert_array_equal(shard.diverged_at, -1)
    assert_array_equal(shard.best_score, shard.validation.max(axis=1))
    assert_array_equal(shard.best_step, shard.validation_steps[shard.validation.argmax(axis=1)])
    assert progress[-1].steps == progress[-1].total_steps == 6000
    assert 9 < progress[-1].mean_episode_length < 40
    assert set(shard.seconds) == {"train", "validate"}


@pytest.mark.slow
def test_best_weights_are_those_of_the_best_validation():
    agents = stack([make_agent(i) for i in range(2)])
    (shard,), _ = train(agents)
    algorithm = dqn.algorithm(DQNSpec(total_steps=2000))
    keys = jax.random.split(jax.random.key(9), (2, 4))

    def score(agent, weights, draws):
        scenario = agent.scenario
        return rollouts(algorithm.policy(agent.hyper, weights), scenario.params, scenario.layout, draws).length.mean()

    assert_allclose(jax.vmap(score)(agents, shard.best, keys), shard.best_score, rtol=1e-6)
    assert_allclose(jax.vmap(score)(agents, shard.last, keys), shard.validation[:, -1], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.bits
def test_shards_padding_and_devices_do_not_change_an_agent():
    agents = stack([make_agent(i) for i in range(5)])
    (whole,), _ = train(agents, 1000, partition=Partition(1, 6, 2, 0))
    split, _ = train(agents, 1000, partition=Partition(2, 4, 2, 0))
    single, _ = train(agents, 1000, partition=Partition(1, 5, 1, 0))
    assert [len(shard.best_step) for shard in split] == [4, 1]
    pieces = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(shard.last for shard in split))
    for other in (pieces, single[0].last):
        chex.assert_trees_all_close(whole.last, other, rtol=1e-2, atol=1e-3)


@pytest.mark.slow
def test_small_replay_wraps():
    agents = stack([make_agent(0), make_agent(1)])
    (shard,), _ = train(agents, replay_capacity=100)
    assert_array_equal(shard.diverged_at, -1)
    chex.assert_tree_all_finite(shard.validation)


@pytest.mark.slow
def test_odd_train_frequency_and_widths():
    (shard,), _ = train(stack([make_agent(0)]), steps=1001, train_frequency=3, hidden=(8,), batch_size=5)
    assert shard.chunk_steps[-1] == 1002  # whole iterations
    assert shard.last["params"]["TorchDense_0"]["kernel"].shape == (1, 24, 8)


@pytest.mark.slow
def test_dqn_learns_to_beat_random_by_far():
    # 12 powered, 8 connected: the random policy lives about 16 slots, oldest-first 29. Best weights of 60,000 steps.
    agents = stack([make_agent(i, powered=12, connected=8) for i in range(4)])
    (shard,), _ = train(agents, steps=60_000, validation=Validation(every=5_000, draws=8))
    algorithm = dqn.algorithm(DQNSpec(total_steps=60_000))
    keys = jax.random.split(jax.random.key(77), (4, 16))

    def lifetimes(agent, weights, draws):
        params, layout = agent.scenario.params, agent.scenario.layout
        policies = (algorithm.policy(agent.hyper, weights), HEURISTICS["random"])
        return [rollouts(policy, params, layout, draws).length.mean() for policy in policies]

    learned, random = jax.vmap(lifetimes)(agents, shard.best, keys)
    assert learned.mean() > 1.4 * random.mean()


@pytest.mark.parametrize("counts_traffic", [False, True])
def test_best_validation_has_the_longest_life_or_the_highest_return(counts_traffic):
    """Staying at device 0 lasts as long as staying at device 1, but device 1 is where the traffic is."""
    scenario = make_scenario(layout=sample_layout(jax.random.key(5), Params(), 12, 12))
    weight = jnp.zeros((1, 12)).at[0, 1].set(1.0)
    reward = make_reward("U", traffic_bonus=2.0 if counts_traffic else 0.0)
    scenario = replace(scenario, layout=replace(scenario.layout, traffic=Traffic(weight)), reward=reward)
    algorithm = replace(dqn.algorithm(DQNSpec(total_steps=200)), greedy=lambda hyper, device, observation: device)
    agent = replace(make_agent(), scenario=scenario)
    best = Best(jnp.int32(7), jnp.float32(-jnp.inf), jnp.int32(0))
    keys = jax.random.split(jax.random.key(0), 2)
    first, best = _validate(algorithm, agent, keys, jnp.int32(0), best, jnp.int32(10))
    second, best = _validate(algorithm, agent, keys, jnp.int32(1), best, jnp.int32(20))
    earned = 33 * 34 / 2 + 33  # the slot that the UAV's battery cannot pay for is the 34th decision, with U = 33
    assert first == (earned if counts_traffic else 33)
    assert second == (earned + 2 * 34 if counts_traffic else 33)
    assert (int(best.weights), int(best.step)) == ((1, 20) if counts_traffic else (0, 10))

"""The training of a shard: the host loop in stretches, saving and restoring, regrouping, and no recompilation."""

from contextlib import contextmanager
from dataclasses import replace

import chex
import jax
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tests.populations import differs, make_agent, stack, take
from uavmec_jax.agents import a2c
from uavmec_jax.training.chunks import Validation
from uavmec_jax.training.partition import Partition
from uavmec_jax.training.population import train_population
from uavmec_jax.training.regroup import regroup
from uavmec_jax.training.training import Trainer

ALGORITHM = a2c.algorithm(a2c.A2CSpec(total_steps=200, hidden=(4,)))
VALIDATION = Validation(every=100, draws=2, chunks=2)
PARTITION = Partition(shards=2, shard_size=4, groups=2, shard_bytes=0)


@contextmanager
def compilations():
    """A list of what is compiled meanwhile, by JAX's own count."""
    compiled = []

    def listener(event, duration, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(duration)

    jax.monitoring.register_event_duration_secs_listener(listener)
    try:
        yield compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listener)


def traced_at_most_once(algorithm):
    """The algorithm; tracing its update a second time is an error."""
    chex.clear_trace_counter()

    @chex.assert_max_traces(n=1)
    def update(agent, state, first, last):
        return algorithm.update(agent, state, first, last)

    return replace(algorithm, update=update)


@pytest.fixture(scope="module")
def population():
    agents = stack([make_agent(i, hyper_class=a2c.A2CHyper) for i in range(8)])
    return agents, jax.random.split(jax.random.key(9), (8, VALIDATION.draws))


@pytest.fixture(scope="module")
def trainer(population):
    return Trainer.compile(ALGORITHM, *take(population, slice(4)), VALIDATION, PARTITION)


@pytest.fixture(scope="module")
def whole(trainer, population):
    training = trainer.start(*take(population, slice(4)))
    assert len(list(training.run())) == len(trainer.chunks) == 4
    return training.result(4)


def assert_same_result(result, other):
    chex.assert_trees_all_equal(
        *({name: value for name, value in vars(shard).items() if name != "seconds"} for shard in (result, other))
    )


def test_training_runs_in_stretches(trainer, population, whole):
    training = trainer.start(*take(population, slice(4)))
    assert len(list(training.run(until=1))) == 1
    assert (training.chunks_done, training.steps, training.validated, training.finished) == (1, 50, False, False)
    assert list(training.run(until=1)) == []
    assert len(list(training.run(until=2))) == 1
    assert (training.chunks_done, training.steps, training.validated) == (2, 100, True)
    for _ in training.run():
        assert training.consistent
        break  # stopped between two chunks, as by a signal
    assert (training.chunks_done, training.finished) == (3, False)
    list(training.run())
    assert training.finished
    assert_same_result(training.result(4), whole)
    assert_array_equal(training.best_scores, whole.best_score)


def test_restored_training_continues_to_the_same_result(trainer, population, whole):
    training = trainer.start(*take(population, slice(4)))
    list(training.run(until=3))
    saved = {name: np.array(array) for name, array in training.arrays().items()}
    restored = trainer.start(*take(population, slice(4)))
    restored.restore(3, saved)
    list(restored.run())
    assert_same_result(restored.result(4), whole)
    with pytest.raises(ValueError, match=r"curves/episode_slots is missing, or not 2 x 4 numbers"):
        trainer.start(*take(population, slice(4))).restore(2, saved | {"curves/episode_slots": np.zeros((2, 4))})


def test_padding_is_left_out(trainer, population):
    training = trainer.start(*take(population, np.array([0, 1, 2, 2])))
    list(training.run())
    result = training.result(3)
    chex.assert_tree_shape_prefix((result.best, result.last, result.validation, result.best_step), (3,))


def test_all_shards_share_one_compilation(population):
    shards = train_population(traced_at_most_once(ALGORITHM), *population, validation=VALIDATION, partition=PARTITION)
    first = next(shards)
    with compilations() as compiled:
        (second,) = shards
    assert compiled == []
    assert any(differs(first.last, second.last))


@pytest.mark.slow
def test_regrouping_keeps_each_agent_and_compiles_nothing_twice(population):
    with compilations() as compiled:
        trainer = Trainer.compile(traced_at_most_once(ALGORITHM), *take(population, slice(4)), VALIDATION, PARTITION)
    assert len(compiled) >= 3

    def train_and_regroup(members):
        trainings = [trainer.start(*take(population, slice(first, first + 4))) for first in (0, 4)]
        for training in trainings:
            list(training.run(until=2))
        before = [take(training.weights(4)["last"], k) for training in trainings for k in range(4)]
        curves = np.concatenate([np.stack(training.episodes, 1) for training in trainings])
        (regrouped,) = regroup(trainings, members)
        assert (regrouped.chunks_done, regrouped.trainer) == (2, trainer)
        assert_array_equal(np.stack(regrouped.episodes, 1)[: len(members)], curves[members])
        for k, member in enumerate(members):
            chex.assert_trees_all_equal(take(regrouped.weights(4)["last"], k), before[member])
        list(regrouped.run())
        return regrouped.result(len(members))

    train_and_regroup(np.array([6, 1, 3]))
    with compilations() as compiled:
        result = train_and_regroup(np.array([5, 0, 2]))
    assert compiled == []
    chex.assert_tree_all_finite(result.last)

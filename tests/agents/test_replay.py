"""The replay buffer against a plain list of transitions."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from uavmec_jax.agents import replay
from uavmec_jax.agents.replay import ReplaySpec

GAMMA = 0.9


def test_size_of_a_row_and_of_the_paper_grid():
    assert ReplaySpec(n_devices=12, capacity=1_000_000, wraps=False).words == 16  # 64 bytes, one cache line
    assert 75 * ReplaySpec(n_devices=12, capacity=1_000_000, wraps=False).bytes < 8 * 2**30


def filled(spec, n, seed=0):
    """Write ``n`` random transitions; return the buffer and the list of them (last: whether an episode ended)."""
    rng = np.random.default_rng(seed)
    d = spec.n_devices
    initial = np.concatenate([np.ones(d), np.zeros(d)]).astype(np.float32)
    buffer_state, stored, observation = replay.init(spec), [], initial
    for start in range(0, n, spec.stride):
        new = []
        for _ in range(spec.stride):
            battery = rng.random(d, np.float32)
            age = rng.integers(0, spec.max_age + 1, d).astype(np.int32)
            action, reward = int(rng.integers(d)), np.float32(rng.normal())
            terminated = bool(rng.random() < 0.2)
            ended = terminated or bool(rng.random() < 0.1)
            new.append(
                replay.pack(
                    spec, jnp.int32(action), jnp.float32(reward), jnp.asarray(battery), jnp.asarray(age),
                    jnp.asarray(terminated), jnp.asarray(ended),
                )
            )  # fmt: skip
            next_observation = np.concatenate([battery, age.astype(np.float32)])
            stored.append((observation, action, reward, float(terminated), next_observation, ended))
            observation = initial if ended else next_observation
        buffer_state = replay.add(spec, buffer_state, jnp.int32(start), jnp.stack(new))
    return buffer_state, stored


@pytest.mark.parametrize(
    ("n_devices", "capacity", "stride", "max_age", "written", "wraps"),
    [
        (12, 40, 4, 11, 24, False),
        (3, 10, 1, 250, 37, True),
        pytest.param(12, 40, 4, 11, 40, False, marks=pytest.mark.slow),
        pytest.param(12, 16, 4, 11, 100, True, marks=pytest.mark.slow),
        pytest.param(64, 9, 5, 30, 60, True, marks=pytest.mark.slow),
    ],
)
def test_every_transition_is_stored_exactly(jit, n_devices, capacity, stride, max_age, written, wraps):
    spec = ReplaySpec(n_devices, capacity, stride, wraps, max_age=max_age)
    buffer_state, stored = filled(spec, written)
    size = min(written, capacity)
    sample = jit(functools.partial(replay.sample, spec))
    batch = sample(buffer_state, jnp.int32(written), jnp.arange(size, dtype=jnp.uint32), GAMMA)
    for i in range(size):  # word i samples the transition i before the newest
        observation, action, reward, terminated, next_observation, _ = stored[-1 - i]
        assert_array_equal(batch.observation[i], observation)
        assert_array_equal(batch.next_observation[i], next_observation)
        assert (batch.action[i], batch.reward[i], batch.terminated[i]) == (action, reward, terminated)
    assert_array_equal(batch.discount, np.float32(GAMMA))


def test_the_rows_of_many_agents_lie_in_memory_as_the_array_says():
    """On a GPU, XLA would choose another order for the loop and keep a second copy of all buffers for it."""
    spec = ReplaySpec(n_devices=12, capacity=100)
    shape = (5, spec.ring + 1, spec.words)
    arrays = (jnp.zeros(shape, jnp.uint32), jnp.int32(0), jnp.zeros((5, spec.stride, spec.words), jnp.uint32))
    add = jax.jit(jax.vmap(functools.partial(replay.add, spec), (0, None, 0)))
    line = next(line for line in add.lower(*arrays).as_text().splitlines() if "@LayoutConstraint" in line)
    assert "result_layouts = [dense<[2, 1, 0]> : tensor<3xindex>]" in line
    assert line.endswith(f"tensor<{'x'.join(map(str, shape))}xui32>")


def test_sampling_is_uniform_and_with_replacement():
    spec = ReplaySpec(n_devices=2, capacity=50, stride=1, wraps=True)
    buffer_state, _ = filled(spec, 70)
    # the reward identifies the transition
    bits = jax.random.bits(jax.random.key(0), (20_000,))
    rewards = np.asarray(replay.sample(spec, buffer_state, jnp.int32(70), bits, GAMMA).reward)
    values, counts = np.unique(rewards, return_counts=True)
    assert len(values) == 50
    assert stats.chisquare(counts).pvalue > 1e-3
    few = np.asarray(replay.sample(spec, buffer_state, jnp.int32(70), bits[:40], GAMMA).reward)
    assert len(np.unique(few)) < 40  # 40 of 50 without replacement would all differ


def test_only_written_transitions_are_sampled():
    spec = ReplaySpec(n_devices=2, capacity=1000, stride=1, wraps=False)
    buffer_state, stored = filled(spec, 5)
    batch = replay.sample(spec, buffer_state, jnp.int32(5), jax.random.bits(jax.random.key(0), (500,)), GAMMA)
    assert set(np.asarray(batch.reward).tolist()) == {float(reward) for _, _, reward, *_ in stored}


@pytest.mark.parametrize(
    ("capacity", "written", "wraps", "n_step"),
    [(40, 40, False, 3), (16, 100, True, 3), (16, 100, True, 10), (5, 60, True, 12)],  # the last sums up to the newest
)
def test_n_step_returns(jit, capacity, written, wraps, n_step):
    spec = ReplaySpec(3, capacity, wraps=wraps, n_step=n_step)
    buffer_state, stored = filled(spec, written)
    sample = jit(functools.partial(replay.sample, spec))
    batch = sample(buffer_state, jnp.int32(written), jnp.arange(capacity, dtype=jnp.uint32), GAMMA)
    for i in range(capacity):
        summed, total = 0, 0.0
        for transition in stored[len(stored) - 1 - i :][:n_step]:  # up to the newest one
            total += GAMMA**summed * transition[2]
            summed += 1
            if transition[5]:
                break
        assert_allclose(batch.reward[i], total, rtol=1e-5, atol=1e-6)
        assert_allclose(batch.discount[i], GAMMA**summed, rtol=1e-6)
        assert_array_equal(batch.observation[i], stored[-1 - i][0])
        assert_array_equal(batch.next_observation[i], transition[4])
        assert batch.terminated[i] == transition[3]
        assert batch.action[i] == stored[-1 - i][1]

"""Stable-Baselines3 on the batched environment: uv run --group sb3 pytest tests/clients -m clients -W default."""

import numpy as np
import pytest
import stable_baselines3 as sb3
from numpy.testing import assert_allclose, assert_array_equal
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize

import uavmec_jax as um
from uavmec_jax.interop import UavMecGymEnv, UavMecSB3VecEnv, UavMecVectorEnv

pytestmark = pytest.mark.clients


@pytest.mark.parametrize("observation", ["paper", "full"])
def test_the_checker_passes(observation):
    check_env(UavMecGymEnv(observation=observation), warn=False)


def test_it_steps_as_the_vector_environment():
    ours, plain = UavMecSB3VecEnv(4), UavMecVectorEnv(4)
    ours.seed(3)
    assert_array_equal(ours.reset(), plain.reset(seed=3)[0])
    returns, ended_before = np.zeros(4), np.zeros(4, bool)
    for slot in range(25):
        actions = np.array([slot, 2 * slot, 0, 7 * slot]) % 12
        observation, reward, done, infos = ours.step(actions)
        same, same_reward, terminated, truncated, info = plain.step(actions)
        assert_array_equal(observation, same)
        assert_array_equal(reward, same_reward)
        assert_array_equal(done, terminated | truncated)
        returns += reward
        for index in range(4):
            if not done[index]:
                assert infos[index] == {}
                continue
            assert_array_equal(infos[index]["terminal_observation"], info["final_obs"][index])
            assert infos[index]["TimeLimit.truncated"] is False
            assert infos[index]["cause"] == info["cause"][index] != "none"
            assert infos[index]["episode"]["l"] == infos[index]["length"] == info["length"][index]
            assert_allclose(infos[index]["episode"]["r"], returns[index], rtol=1e-6)
        returns[done] = 0.0
        ended_before |= done
    assert ended_before.all()


def test_it_is_a_vec_env_like_others():
    envs = UavMecSB3VecEnv(3, powered=6, connected=6, observation="full", reward="M")
    assert envs.get_attr("num_envs", [0, 2]) == [3, 3]
    assert envs.env_is_wrapped(VecMonitor) == [False] * 3
    with pytest.raises(AttributeError, match="scenario cannot be set in environments that are stepped together"):
        envs.set_attr("scenario", None)
    with pytest.raises(AttributeError, match="reset cannot be called"):
        envs.env_method("reset")
    envs.reset()
    with pytest.raises(um.ArgumentError, match="action of environment 3 is 12"):
        envs.step(np.array([0, 1, 12]))
    envs.close()


@pytest.mark.parametrize(
    ("algorithm", "options"), [("PPO", {"n_steps": 16, "batch_size": 32}), ("DQN", {"learning_starts": 64})]
)
def test_an_algorithm_trains(algorithm, options):
    envs = VecNormalize(VecMonitor(UavMecSB3VecEnv(8)))
    model = getattr(sb3, algorithm)("MlpPolicy", envs, seed=0, **options).learn(512)
    assert len(model.ep_info_buffer) > 10
    mean, _ = evaluate_policy(model, UavMecGymEnv(), n_eval_episodes=2, warn=False)
    assert np.isfinite(mean)


@pytest.mark.parametrize("vec_env", [DummyVecEnv, SubprocVecEnv])
def test_one_environment_each(vec_env):
    envs = vec_env([UavMecGymEnv] * 2)
    try:
        assert envs.reset().shape == (2, 24)
        assert envs.step(np.array([1, 2]))[1].shape == (2,)
    finally:
        envs.close()

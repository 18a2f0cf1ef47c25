"""The options of Gymnasium's environments, pickles, processes, and whose the arrays are."""

import pickle
import subprocess
import sys

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import uavmec_jax as um
from uavmec_jax.agents.observation_spec import OBSERVATIONS
from uavmec_jax.interop import ENV_ID, UavMecGymEnv, UavMecVectorEnv

VILLAGE = "docs/examples/village.csv"


def make(**options):
    return gymnasium.make(ENV_ID, **options)


def random_layout(powered, connected, seed):
    return um.sample_layout(jax.random.key(seed), um.Params(), powered, connected)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, (8, 8, 0)),
        ({"powered": 4}, (4, 8, 0)),
        ({"connected": 0, "layout_seed": 3}, (8, 0, 3)),
        ({"powered": 12, "connected": 6, "layout_seed": 2**31 - 1}, (12, 6, 2**31 - 1)),
    ],
)
def test_random_layouts(options, expected):
    assert_array_equal(make(**options).unwrapped.scenario.layout.position, random_layout(*expected).position)
    assert_array_equal(make(**options).unwrapped.scenario.layout.has_power, random_layout(*expected).has_power)


def test_random_layouts_of_the_vector_environment_follow_their_seeds():
    envs = gymnasium.make_vec(ENV_ID, num_envs=3, powered=4, connected=6, layout_seed=5)
    expected = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(random_layout(4, 6, 5 + i) for i in range(3)))
    assert_array_equal(envs.unwrapped._scenarios.layout.position, expected.position)


def test_a_file_a_scenario_and_rewards():
    named = um.load_scenario(VILLAGE)
    env = make(scenario=VILLAGE, reward="M")
    assert env.action_space.n == len(named.device_names)
    assert_array_equal(env.unwrapped.scenario.layout.position, named.layout.position)
    env.reset(seed=0)
    assert env.step(0)[1] == pytest.approx(um.make_reward("M").weights @ np.ones(8), abs=10)
    scenario = um.make_scenario(named.layout, named.params, um.make_reward("U"))
    assert_array_equal(UavMecGymEnv(scenario).scenario.reward.weights, um.make_reward("U").weights)
    own = um.make_reward({"U": 2.0})
    assert_array_equal(UavMecGymEnv(scenario, reward=own).scenario.reward.weights, own.weights)
    envs = UavMecVectorEnv(2, scenario=VILLAGE, reward=own)
    envs.reset(seed=0)
    assert envs.step(np.array([0, 1]))[1].shape == (2,)


def test_the_full_observation():
    env, envs = make(observation="full"), UavMecVectorEnv(2, um.make_scenario(), observation="full")
    layout, observe = env.unwrapped.scenario.layout, OBSERVATIONS["full"].observation_fn
    state = um.initial_state(um.Params(), layout)
    expected = observe(um.Params(), layout, state)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert_allclose(observation, expected, rtol=1e-6)
    assert_allclose(envs.reset(seed=0)[0], np.stack([expected] * 2), rtol=1e-6)
    assert env.step(3)[0].shape == envs.step(np.array([3, 4]))[0][0].shape == expected.shape


@pytest.mark.usefixtures("without_type_checks")
@pytest.mark.parametrize("env", [UavMecGymEnv, lambda **options: UavMecVectorEnv(2, **options)])
@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"observation": "half"}, "observation is 'half'; it should be 'paper' or 'full'"),
        ({"powered": 13}, "powered is 13; it should be a whole number from 0 to 12"),
        ({"connected": 2.5}, "connected is 2.5; it should be a whole number from 0 to 12"),
        ({"layout_seed": -1}, "layout_seed is -1; it should be a whole number from 0"),
        ({"reward": "Z"}, "unknown reward 'Z'; rewards are"),
        ({"scenario": "nowhere.toml"}, "nowhere.toml"),
        ({"scenario": VILLAGE, "powered": 4}, "powered is for random layouts, and a scenario is given"),
    ],
)
def test_bad_options_are_named(env, options, line):
    with pytest.raises(um.UserError) as refused:
        env(**options)
    assert line in str(refused.value)


@pytest.mark.parametrize("observation", ["paper", "full"])
def test_a_pickled_environment_goes_on_where_it_was(observation):
    env = make(observation=observation, powered=4, reward="M")
    env.reset(seed=3)
    for action in range(3):
        env.step(action)
    copy = pickle.loads(pickle.dumps(env))
    for action in range(3, 6):
        one, other = env.step(action), copy.step(action)
        assert_array_equal(one[0], other[0])
        assert one[1:4] == other[1:4]
    assert_array_equal(env.reset(seed=1)[0], copy.reset(seed=1)[0])


def arrays(value):
    """All arrays in what an environment returned."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, tuple | list):
        return [array for child in value for array in arrays(child)]
    return [value] if isinstance(value, np.ndarray) else []


def test_arrays_are_the_callers_own():
    """They can be written, and writing into them changes nothing that comes later."""
    for env, action in ((UavMecGymEnv(), 0), (UavMecVectorEnv(2, um.make_scenario()), np.zeros(2, int))):
        clean = []
        for spoil in (False, True):
            seen = [env.reset(seed=0)]
            for _ in range(12):
                seen.append(env.step(action))
                clean += [array.copy() for array in arrays(seen[-1]) if array.dtype != object]
                for array in arrays(seen) if spoil else ():
                    array[...] = 0
        half = len(clean) // 2
        assert half > 24
        for one, other in zip(clean[:half], clean[half:], strict=True):
            assert_array_equal(one, other)


ASYNC = f"""
import gymnasium
import numpy as np
import uavmec_jax.interop

if __name__ == "__main__":
    envs = gymnasium.make_vec("{ENV_ID}", num_envs=2, vectorization_mode="async", vector_kwargs=CONTEXT, powered=6)
    print(envs.reset(seed=0)[0].shape, envs.step(np.array([1, 2]))[1].shape)
    envs.close()
"""


def run_async(tmp_path, context):
    script = tmp_path / "script.py"
    script.write_text(ASYNC.replace("CONTEXT", repr(context)))
    return subprocess.run([sys.executable, "-P", script], capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_forked_environments_say_at_once_what_to_do(tmp_path):
    done = run_async(tmp_path, {"context": "fork"})
    assert done.returncode != 0
    assert "this process was forked from one that has used JAX, which cannot work in it" in done.stderr
    assert "vector_kwargs={'context': 'spawn'}" in done.stderr


@pytest.mark.slow
def test_environments_in_processes_of_their_own_work(tmp_path):
    done = run_async(tmp_path, {"context": "spawn"})
    assert (done.returncode, done.stdout) == (0, "(2, 24) (2,)\n"), done.stderr

"""rejax, which expects the step of gymnax 0.0.9.

uv run --no-default-groups --group rejax pytest tests/clients -m clients -W default
"""

import jax
import numpy as np
import pytest
import rejax
from rejax.evaluate import evaluate

from uavmec_jax.interop import FiveValueEnv

pytestmark = pytest.mark.clients


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("ppo", {"num_envs": 4, "num_steps": 32, "num_epochs": 2, "num_minibatches": 4}),
        ("dqn", {"num_envs": 4, "buffer_size": 500, "fill_buffer": 100, "batch_size": 16}),
        ("pqn", {"num_envs": 4, "num_steps": 32, "num_epochs": 2, "num_minibatches": 4}),
    ],
)
def test_an_algorithm_trains(name, settings):
    env = FiveValueEnv()
    params = env.default_params
    algorithm = rejax.get_algo(name).create(
        env=env, env_params=params, total_timesteps=1024, eval_freq=1024, skip_initial_evaluation=True, **settings
    )
    state, (lengths, returns) = jax.jit(algorithm.train)(jax.random.key(0))
    assert np.isfinite(np.asarray(returns)).all()
    lengths, _ = evaluate(algorithm.make_act(state), jax.random.key(1), env, params, 8, params.max_steps_in_episode)
    assert ((lengths >= 10) & (lengths <= 40)).all()

"""One trace of an update serves every chunk, scenario, reward and hyperparameter."""

import chex
import jax
import numpy as np
import pytest

from tests.populations import make_agent, over_agents, stack
from uavmec_jax.agents import a2c, dqn, ppo, pqn
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import make_reward

ALGORITHMS = {
    "dqn": (dqn.algorithm(dqn.DQNSpec(total_steps=100, hidden=(4,), batch_size=2)), dqn.DQNHyper),
    "a2c": (a2c.algorithm(a2c.A2CSpec(total_steps=100, hidden=(4,))), a2c.A2CHyper),
    "ppo": (
        ppo.algorithm(ppo.PPOSpec(total_steps=100, hidden=(4,), n_steps=4, batch_size=2, n_epochs=1)),
        ppo.PPOHyper,
    ),
    "pqn": (
        pqn.algorithm(pqn.PQNSpec(total_steps=100, hidden=(4,), n_envs=2, n_steps=4, batch_size=4, n_epochs=2)),
        pqn.PQNHyper,
    ),
}


@pytest.mark.parametrize(
    "name", ["a2c", *(pytest.param(name, marks=pytest.mark.slow) for name in ("dqn", "ppo", "pqn"))]
)
def test_update_is_traced_once(name):
    algorithm, hyper_class = ALGORITHMS[name]
    chex.clear_trace_counter()

    @chex.assert_max_traces(n=1)
    def update(agent, state, first, last):
        return algorithm.update(agent, state, first, last)

    update = over_agents(update, 0, 0, None, None)
    init = jax.jit(jax.vmap(algorithm.init))
    agents = stack([make_agent(i, hyper_class=hyper_class) for i in range(2)])
    others = stack([make_agent(i, powered=4, hyper_class=hyper_class, learning_rate=0.1, gamma=0.5) for i in range(2)])
    rewards = stack([make_reward("U")] * 2)
    others = others.replace(scenario=others.scenario.replace(reward=rewards))
    state = update(agents, init(agents), np.int32(0), np.int32(2))
    update(agents, state, np.int32(2), np.int32(5))
    update(others, init(others), np.int32(0), np.int32(2))


def test_dqn_takes_as_many_devices_as_its_replay_can_tell_apart():
    assert dqn.algorithm(dqn.DQNSpec(n_devices=256)).name == "dqn"
    with pytest.raises(
        ValueError,
        match=r"^n_devices is 257; a DQN replay holds at most 256 devices; give observation = 'full', or take pqn, ppo or a",
    ):
        dqn.algorithm(dqn.DQNSpec(n_devices=257))
    assert dqn.algorithm(dqn.DQNSpec(n_devices=257, observation="full")).name == "dqn"


@pytest.mark.parametrize(
    ("make", "spec", "hyper_class"),
    [
        (a2c.algorithm, a2c.A2CSpec, a2c.A2CHyper),
        (ppo.algorithm, ppo.PPOSpec, ppo.PPOHyper),
        (pqn.algorithm, pqn.PQNSpec, pqn.PQNHyper),
    ],
)
def test_algorithms_without_a_replay_take_more(make, spec, hyper_class):
    algorithm = make(spec(total_steps=100, hidden=(4,), n_devices=300))
    agents = stack([make_agent(params=Params(n_devices=300), hyper_class=hyper_class)])
    state = jax.eval_shape(over_agents(algorithm.init, 0), agents)
    after = jax.eval_shape(over_agents(algorithm.update, 0, 0, None, None), agents, state, np.int32(0), np.int32(1))
    chex.assert_trees_all_equal_shapes(after, state)

"""Agents for the tests."""

import jax
import jax.numpy as jnp

from uavmec_jax.agents.algorithm import Agent
from uavmec_jax.agents.dqn import DQNHyper
from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import make_reward
from uavmec_jax.env.scenario import Scenario


def make_agent(seed=0, powered=8, connected=8, params=None, kind=DQNHyper, **hyper) -> Agent:
    """One agent on a random layout; ``kind`` declares its hyperparameters."""
    params = Params() if params is None else params
    layout = sample_layout(jax.random.key(seed), params, powered, connected)
    scenario = Scenario(params=params, layout=layout, reward=make_reward())
    return jax.tree.map(jnp.asarray, Agent(jax.random.key(1000 + seed), scenario, kind(**hyper)))


def stack(agents) -> Agent:
    """A population, leaves ``[A, ...]``."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *agents)


def take(tree, i):
    """Agent ``i`` of a population."""
    return jax.tree.map(lambda leaf: leaf[i], tree)

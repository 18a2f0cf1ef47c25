"""Agents for the tests."""

import jax
import jax.numpy as jnp
import numpy as np

from uavmec_jax.agents.algorithm import AGENTS_AXIS, Agent
from uavmec_jax.agents.dqn import DQNHyper
from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import make_reward
from uavmec_jax.env.scenario import Scenario


def make_agent(seed=0, powered=8, connected=8, params=None, hyper_class=DQNHyper, **hyper) -> Agent:
    """One agent on a random layout; ``hyper_class`` declares its hyperparameters."""
    params = Params() if params is None else params
    layout = sample_layout(jax.random.key(seed), params, powered, connected)
    scenario = Scenario(params=params, layout=layout, reward=make_reward())
    return jax.tree.map(jnp.asarray, Agent(jax.random.key(1000 + seed), scenario, hyper_class(**hyper)))


def stack(agents) -> Agent:
    """A population, leaves ``[A, ...]``."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *agents)


def take(tree, i):
    """Agent ``i`` of a population."""
    return jax.tree.map(lambda leaf: leaf[i], tree)


def over_agents(function, *axes):
    """Jit a function of one agent for a population; ``axes`` are 0 for arguments ``[A, ...]``, ``None`` for shared ones."""
    return jax.jit(jax.vmap(function, axes, axis_name=AGENTS_AXIS))


def differs(tree, other):
    """Whether each leaf differs from the other tree's."""
    return [
        bool((np.asarray(a) != np.asarray(b)).any()) for a, b in zip(*map(jax.tree.leaves, (tree, other)), strict=True)
    ]

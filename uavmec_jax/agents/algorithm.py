"""What every learning algorithm is: a pair of pure functions over one agent, and a policy made from its weights."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from flax import struct
from jaxtyping import Array

from uavmec_jax.agents.observation_spec import OBSERVATIONS
from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy

AGENTS_AXIS = "agents"
"""Name of the ``vmap`` axis of the population; ``update`` runs under it."""


@struct.dataclass
class Agent:
    """One learning problem: constant while training. Batched by ``vmap``.

    Attributes:
        key: the agent's own randomness, from its identity, never from its place in a batch.
        scenario: what it plays: one scenario, or (PPO and A2C) a distribution, from which every episode draws its own.
        hyper: how it learns; the algorithm's pytree of traced hyperparameters.
    """

    key: Any
    scenario: Any
    hyper: Any


class LearnerState(Protocol):
    """The part of an algorithm's state that the population looks at (leaves ``[B, ...]``)."""

    weights: Any
    diverged_at: Any
    episode_slots: Any
    episodes: Any


@dataclass(frozen=True)
class Algorithm:
    """An algorithm with its static settings bound.

    Attributes:
        name: as in study files.
        iterations: length of a training, in iterations.
        steps_per_iteration: environment steps of one agent in one iteration.
        agent_bytes: memory of one agent in training.
        init: ``(agent) -> state``.
        update: ``(agent, state, first, last) -> state``: the iterations ``first <= i < last``; the two bounds are
            shared by all agents and never batched. Runs under ``vmap(axis_name=AGENTS_AXIS)``.
        greedy: ``(hyper, weights, observation [..., obs_size]) -> action [...]`` int32, the best one in the eyes of the weights.
        observation_fn: ``(params, layout, state) -> observation [..., obs_size]``; by default the paper's.
        value_fn: ``(hyper, weights, observation [B, obs_size]) -> [B]``, what the rest of an episode is worth; ``None`` where
            there is no value_fn.
    """

    name: str
    iterations: int
    steps_per_iteration: int
    agent_bytes: int
    init: Callable[[Agent], Any]
    update: Callable[[Agent, Any, Any, Any], Any]
    greedy: Callable[[Any, Any, Array], Array]
    observation_fn: Callable[[Params, Layout, State], Array] = OBSERVATIONS["paper"].observation_fn
    value_fn: Callable[[Any, Any, Array], Array] | None = None

    def policy(self, hyper: Any, weights: Any) -> Policy:
        """The greedy policy of an agent; ties go to the lowest number. States may be batched."""

        def act(params: Params, layout: Layout, state: State, key: Any = None) -> Array:
            return self.greedy(hyper, weights, self.observation_fn(params, layout, state))

        return act

    @property
    def total_steps(self) -> int:
        """Environment steps of one agent in a whole training."""
        return self.iterations * self.steps_per_iteration

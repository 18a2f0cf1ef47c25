"""The interface of the learning algorithms: a pair of pure functions over one agent, and a policy from its weights."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from flax import struct
from jaxtyping import Array, Int, Key

from uavmec_jax.agents.networks import Weights
from uavmec_jax.env.dynamics import State
from uavmec_jax.env.generator import ScenarioDistribution
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.observation import observe
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy
from uavmec_jax.env.scenario import Scenario

AGENTS_AXIS = "agents"
"""Name of the ``vmap`` axis of the population; ``update`` runs under it."""


@struct.dataclass
class Agent:
    """A learning problem: everything about an agent that does not change during training. ``vmap`` batches it.

    Attributes:
        key: the agent's own randomness, derived from its identity, never from its place in a batch.
        scenario: the scenario of all its episodes, or a distribution from which every episode draws its own.
        hyper: the traced hyperparameters, a pytree that the algorithm declares.
    """

    key: Key[Array, "*batch"]
    scenario: Scenario | ScenarioDistribution
    hyper: Any


@runtime_checkable
class AlgorithmState(Protocol):
    """The part of an algorithm's state that the population reads. Every algorithm's state has it.

    Attributes:
        policy_weights: what the greedy policy is made from.
        diverged_at: environment step at which the agent was frozen, -1 if it has not diverged.
        episode_slots: total length of the training episodes that ended in the last call of ``update``, slots.
        episodes: number of these episodes.
    """

    diverged_at: Int[Array, "*batch"]
    episode_slots: Int[Array, "*batch"]
    episodes: Int[Array, "*batch"]

    @property
    def policy_weights(self) -> Weights:
        """What the greedy policy is made from."""
        raise NotImplementedError


@dataclass(frozen=True)
class Algorithm:
    """An algorithm with its static settings bound.

    Attributes:
        name: as in study files.
        iterations: length of a training, in iterations.
        steps_per_iteration: environment steps of one agent in one iteration.
        agent_bytes: memory of one agent in training.
        init: ``(agent) -> state``.
        update: ``(agent, state, first, last) -> state``: runs the iterations ``first <= i < last``. The two bounds are
            shared by all agents and never batched. Must run under ``vmap(axis_name=AGENTS_AXIS)``.
        greedy: ``(hyper, weights, observation [..., obs_size]) -> action [...]``, int32: the action that the policy
            network finds likeliest, or that has the highest Q-value.
        observation_fn: ``(params, layout, state) -> observation [..., obs_size]``; by default the paper's.
        value_fn: ``(hyper, weights, observation [B, obs_size]) -> value [B]``, the expected return from a state;
            ``None`` if the algorithm learns no state values.
        spec: the static settings; another process binds the algorithm from its name and these.
    """

    name: str
    iterations: int
    steps_per_iteration: int
    agent_bytes: int
    init: Callable[[Agent], Any]
    update: Callable[[Agent, Any, Any, Any], Any]
    greedy: Callable[[Any, Weights, Array], Array]
    observation_fn: Callable[[Params, Layout, State], Array] = observe
    value_fn: Callable[[Any, Weights, Array], Array] | None = None
    spec: Any = field(default=None, compare=False)

    def policy(self, hyper: Any, weights: Weights) -> Policy:
        """Return the greedy policy of an agent. Ties go to the lowest device number; states may be batched."""

        def act(params: Params, layout: Layout, state: State, key: Any = None) -> Int[Array, "*batch"]:
            return self.greedy(hyper, weights, self.observation_fn(params, layout, state))

        return act

    @property
    def total_steps(self) -> int:
        """Environment steps of one agent in a whole training."""
        return self.iterations * self.steps_per_iteration

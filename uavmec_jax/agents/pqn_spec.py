"""What a PQN agent is made of: its hyperparameters, its static settings and its state."""

from dataclasses import dataclass, field

import optax
from flax import linen as nn
from flax import struct
from jaxtyping import Array, Float, Int

from uavmec_jax.agents.environments import Environments
from uavmec_jax.agents.exploration import GUIDES
from uavmec_jax.agents.networks import Weights, count_weights
from uavmec_jax.agents.observation_spec import OBSERVATIONS, ObservationSpec
from uavmec_jax.env.dynamics import State
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.env.types import Scalar


@struct.dataclass
class PQNHyper:
    """Hyperparameters that may differ between agents of one program (traced)."""

    learning_rate: Scalar = struct.field(default=1.2e-3, metadata={"gt": 0})
    learning_rate_final: Scalar = struct.field(default=0.0, metadata={"ge": 0, "le": 1})
    """Learning rate at the end of training divided by that at its beginning; it falls linearly."""
    gamma: Scalar = struct.field(default=1.0, metadata={"ge": 0, "le": 1})
    q_lambda: Scalar = struct.field(default=0.9, metadata={"ge": 0, "le": 1})
    """Weight of longer returns in the targets; 0 gives one-step targets."""
    gap: Scalar = struct.field(default=0.7, metadata={"ge": 0, "lt": 1})
    """Share of an action's disadvantage that is subtracted from its target (advantage learning); 0 is plain Q-learning."""
    exploration_highest_eps: Scalar = struct.field(default=0.95, metadata={"gt": 0, "le": 1})
    """Epsilon of the first environment; those of the others are spread logarithmically, and none changes."""
    exploration_lowest_eps: Scalar = struct.field(default=0.02, metadata={"gt": 0, "le": 1})
    """Epsilon of the last environment."""
    guidance: Scalar = struct.field(default=0.9, metadata={"ge": 0, "le": 1})
    """Share of the exploratory actions that follow the guide, if there is one."""
    average_decay: Scalar = struct.field(default=0.9, metadata={"ge": 0, "lt": 1})
    """Weight of the past in the averaged weights, from one iteration to the next, if weights are averaged."""
    max_grad_norm: Scalar = struct.field(default=10.0, metadata={"gt": 0})
    age_scale: Scalar = struct.field(default=0.1, metadata={"gt": 0})
    """Factor on the ages in the paper's observation; 1 in the paper."""


@dataclass(frozen=True)
class PQNSpec:
    """Static settings, which shape the program."""

    total_steps: int = 1_000_000
    """Environment steps of one agent; rounded up to whole iterations."""
    hidden: tuple[int, ...] = field(default=(64, 64), metadata={"items": {"ge": 1, "le": 4096}, "max_length": 32})
    observation: str = field(default="paper", metadata={"choices": tuple(OBSERVATIONS)})
    """Input of the network: ``paper`` (batteries and ages), or ``full``, with which it is permutation-equivariant."""
    layer_norm: bool = True
    """Whether hidden layers are normalised (Ba et al., 2016)."""
    n_envs: int = field(default=64, metadata={"ge": 1, "le": 4096})
    """Environments of one agent."""
    n_steps: int = field(default=32, metadata={"ge": 1, "le": 1_000_000})
    """Slots played in each environment between updates."""
    batch_size: int = field(default=64, metadata={"ge": 1, "le": 100_000_000})
    """Size of a minibatch; it divides ``n_steps * n_envs``."""
    n_epochs: int = field(default=2, metadata={"ge": 1, "le": 1000})
    """Passes over each rollout."""
    cut_traces: bool = True
    """Whether a lambda-return stops at an action that was not the greedy one (Watkins, 1989)."""
    guide: str = field(default="earliest-deadline", metadata={"choices": GUIDES})
    """Heuristic that exploratory actions may follow; ``none`` explores at random."""
    average_weights: bool = True
    """Whether the policy acts by an exponential moving average of the weights."""
    n_devices: int = 12

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one agent in one iteration."""
        return self.n_steps * self.n_envs

    @property
    def iterations(self) -> int:
        """Iterations of a whole training."""
        return -(-self.total_steps // self.steps_per_iteration)

    @property
    def minibatches(self) -> int:
        """Gradient steps of one epoch."""
        return self.steps_per_iteration // self.batch_size

    @property
    def observation_spec(self) -> ObservationSpec:
        """The observation, and the networks that take it."""
        return OBSERVATIONS[self.observation]

    @property
    def obs_size(self) -> int:
        """Length of an observation."""
        return self.observation_spec.obs_size(self.n_devices)

    @property
    def network(self) -> nn.Module:
        """The Q-network."""
        return self.observation_spec.q_network(self.n_devices, self.hidden, self.layer_norm)

    @property
    def agent_bytes(self) -> int:
        """Memory of one agent in training, bytes.

        That is a rollout and its shuffled copy, the weights, their average, the optimiser's moments, a gradient and the
        best weights.
        """
        rollout = self.steps_per_iteration * (2 * (self.obs_size + 2) + 2 * self.n_devices + 4)
        return 4 * (rollout + 7 * count_weights(self.network, self.obs_size))


@struct.dataclass
class PQNState:
    """Everything that changes while an agent trains.

    Attributes:
        weights: parameters of the Q-network.
        average: their moving average; ``None`` if they are not averaged.
        opt_state: Adam's moments.
        env_states: states of the environments, leaves ``[n_envs, ...]``.
        diverged_at: environment step at which the agent was frozen, int32; -1 if it has not diverged.
        episode_slots: total length of the episodes that ended in this call of ``update``, slots, int32.
        episodes: number of these episodes, int32.
        loss: the last loss.
        scenarios: the scenario of each environment, leaves ``[n_envs, ...]``; ``None`` if all have the agent's.
    """

    weights: Weights
    average: Weights | None
    opt_state: optax.ScaleByAdamState
    env_states: State
    diverged_at: Int[Array, "*batch"]
    episode_slots: Int[Array, "*batch"]
    episodes: Int[Array, "*batch"]
    loss: Float[Array, "*batch"]
    scenarios: Scenario | None = None

    @property
    def environments(self) -> Environments:
        """The environments, and their scenarios."""
        return Environments(self.env_states, self.scenarios)

    @property
    def policy_weights(self) -> Weights:
        """What the greedy policy is made from."""
        return self.weights if self.average is None else self.average

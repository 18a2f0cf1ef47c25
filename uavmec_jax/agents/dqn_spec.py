"""What a DQN agent is made of: its hyperparameters, its static settings and its state."""

from dataclasses import dataclass, field

import optax
from flax import linen as nn
from flax import struct
from jaxtyping import Array, Float, Int, UInt

from uavmec_jax.agents import replay, state_replay
from uavmec_jax.agents.episode import RunningEpisode, ring_bytes
from uavmec_jax.agents.exploration import GUIDES, NO_GUIDE
from uavmec_jax.agents.networks import QNetwork, Weights, count_weights
from uavmec_jax.agents.observation_spec import OBSERVATIONS, ObservationSpec
from uavmec_jax.env.dynamics import State
from uavmec_jax.env.types import Scalar


@struct.dataclass
class DQNHyper:
    """Hyperparameters that may differ between agents of one program (traced).

    The defaults are those of Table 4, and Stable-Baselines3's where the paper gives none.
    """

    learning_rate: Scalar = struct.field(default=0.0071, metadata={"gt": 0})
    learning_rate_final: Scalar = struct.field(default=1.0, metadata={"ge": 0, "le": 1})
    """Learning rate at the end of training divided by that at its beginning; it falls linearly. 1: it stays."""
    gamma: Scalar = struct.field(default=0.98, metadata={"ge": 0, "le": 1})
    exploration_initial_eps: Scalar = struct.field(default=1.0, metadata={"ge": 0, "le": 1})
    exploration_final_eps: Scalar = struct.field(default=0.05, metadata={"ge": 0, "le": 1})
    exploration_fraction: Scalar = struct.field(default=0.35, metadata={"gt": 0, "le": 1})
    """Share of all steps over which epsilon falls linearly."""
    exploration_spread: Scalar = struct.field(default=0.05, metadata={"gt": 0, "le": 1})
    """Lowest epsilon of an episode divided by the schedule's, if every episode has an epsilon of its own."""
    guidance: Scalar = struct.field(default=0.5, metadata={"ge": 0, "le": 1})
    """Share of the exploratory actions that follow the guide, if there is one."""
    gap: Scalar = struct.field(default=0.8, metadata={"ge": 0, "lt": 1})
    """Share of an action's disadvantage that advantage learning subtracts from its target."""
    average_decay: Scalar = struct.field(default=0.999, metadata={"ge": 0, "lt": 1})
    """Weight of the past in the averaged weights, from one gradient step to the next, if weights are averaged."""
    target_interval: Scalar = struct.field(default=10_000, metadata={"ge": 1, "le": 2_000_000_000})
    """Environment steps of one agent between updates of the target network."""
    tau: Scalar = struct.field(default=1.0, metadata={"gt": 0, "le": 1})
    """Weight of the online network in an update of the target network: 1 copies it, less is a soft update."""
    learning_starts: Scalar = struct.field(default=100, metadata={"ge": 0, "le": 2_000_000_000})
    """Environment steps of one agent with random actions and without gradient steps."""
    max_grad_norm: Scalar = struct.field(default=10.0, metadata={"gt": 0})
    age_scale: Scalar = struct.field(default=1.0, metadata={"gt": 0})
    """Factor on the ages in the paper's observation; 1 in the paper."""


@dataclass(frozen=True)
class DQNSpec:
    """Static settings, which shape the program."""

    total_steps: int = 1_000_000
    """Environment steps of one agent; rounded up to whole iterations."""
    hidden: tuple[int, ...] = field(default=(64, 64), metadata={"items": {"ge": 1, "le": 4096}, "max_length": 32})
    observation: str = field(default="paper", metadata={"choices": tuple(OBSERVATIONS)})
    """Input of the network: ``paper`` (batteries and ages), or ``full``, with which it is permutation-equivariant."""
    batch_size: int = field(default=16, metadata={"ge": 1, "le": 1_000_000})
    train_frequency: int = field(default=4, metadata={"ge": 1, "le": 64})
    """Environment steps per gradient step."""
    replay_capacity: int = field(default=1_000_000, metadata={"ge": 1, "le": 2_000_000_000})
    scenario_ring: int = field(default=4096, metadata={"ge": 2, "le": 1_000_000})
    """Drawn scenarios that are kept for the full observation; samples are from the last so many episodes."""
    double: bool = False
    """Whether the online network selects the next action and the target network evaluates it (van Hasselt et al., 2016)."""
    dueling: bool = False
    """Whether the network outputs a state value and advantages instead of Q-values (Wang et al., 2016); that for the full
    observation always does."""
    n_step: int = field(default=1, metadata={"ge": 1, "le": 64})
    """Number of rewards summed before the bootstrap (Sutton, 1988)."""
    advantage_learning: bool = False
    """Whether targets widen the gap between the best action and the others (Bellemare et al., 2016, equation 7)."""
    layer_norm: bool = False
    """Whether hidden layers are normalised (Ba et al., 2016)."""
    spread_epsilon: bool = False
    """Whether every episode has an epsilon of its own, as actors have in Horgan et al. (2018), and not the schedule's."""
    guide: str = field(default=NO_GUIDE, metadata={"choices": GUIDES})
    """Heuristic that exploratory actions may follow; ``none`` explores at random."""
    average_weights: bool = False
    """Whether the policy acts by an exponential moving average of the weights."""
    n_devices: int = 12
    max_age: int = 11

    @property
    def iterations(self) -> int:
        """Iterations of a whole training."""
        return -(-self.total_steps // self.train_frequency)

    @property
    def observation_spec(self) -> ObservationSpec:
        """The observation, and the networks that take it."""
        return OBSERVATIONS[self.observation]

    @property
    def sees_paper(self) -> bool:
        """Whether the observation is the paper's."""
        return self.observation == "paper"

    @property
    def obs_size(self) -> int:
        """Length of an observation."""
        return self.observation_spec.obs_size(self.n_devices)

    @property
    def network(self) -> nn.Module:
        """The Q-network."""
        if self.sees_paper:
            return QNetwork(self.n_devices, self.hidden, dueling=self.dueling, layer_norm=self.layer_norm)
        return self.observation_spec.q_network(self.n_devices, self.hidden, self.layer_norm)

    @property
    def numbers_per_step(self) -> int:
        """Random numbers of an environment step, uniform in [0, 1).

        They are the task volume of each device; whether to explore; with ``spread_epsilon``, the epsilon of the next episode;
        with a guide, whether to follow it; and the random action.
        """
        return self.n_devices + 2 + self.spread_epsilon + (self.guide != NO_GUIDE)

    @property
    def replay(self) -> replay.ReplaySpec | state_replay.StateReplaySpec:
        """The replay buffer; its capacity is cut to the number of steps, which changes nothing."""
        steps = self.iterations * self.train_frequency
        capacity, wraps = min(self.replay_capacity, steps), self.replay_capacity < steps
        shape = {
            "n_devices": self.n_devices,
            "capacity": capacity,
            "stride": self.train_frequency,
            "n_step": self.n_step,
        }
        if self.sees_paper:
            return replay.ReplaySpec(**shape, wraps=wraps, max_age=self.max_age)
        return state_replay.StateReplaySpec(**shape, wraps=wraps)

    @property
    def scenarios_kept(self) -> int:
        """Number of drawn scenarios in memory: none for the paper's observation, at most one per step."""
        return 0 if self.sees_paper else min(self.scenario_ring, self.iterations * self.train_frequency + 1)

    @property
    def agent_bytes(self) -> int:
        """Memory of one agent in training, bytes.

        That is the replay buffer, the scenarios of its samples (even if there is one for all, which is little then), the
        weights, the target's weights, two optimiser moments, a gradient, the best weights and, if there is one, the average
        of the weights.
        """
        buffers = self.replay.bytes + ring_bytes(self.n_devices, self.scenarios_kept)
        return buffers + (6 + self.average_weights) * 4 * count_weights(self.network, self.obs_size)


@struct.dataclass
class DQNState:
    """Everything that changes while an agent trains.

    Attributes:
        weights: parameters of the Q-network.
        target: parameters of the target network.
        opt_state: Adam's moments.
        env_state: state of the environment.
        buffer_state: the replay buffer, see :mod:`uavmec_jax.agents.replay` and :mod:`uavmec_jax.agents.state_replay`.
        diverged_at: environment step at which the agent was frozen, int32; -1 if it has not diverged.
        episode_slots: total length of the episodes that ended in this call of ``update``, slots, int32.
        episodes: number of these episodes, int32.
        loss: the last loss.
        average: moving average of the weights; ``None`` if they are not averaged.
        epsilon_share: epsilon of the running episode divided by the schedule's; ``None`` if all have the schedule's.
        episode: the running episode and the scenarios of earlier ones; ``None`` if all have the agent's scenario.
    """

    weights: Weights
    target: Weights
    opt_state: optax.ScaleByAdamState
    env_state: State
    buffer_state: UInt[Array, "*batch rows words"]
    diverged_at: Int[Array, "*batch"]
    episode_slots: Int[Array, "*batch"]
    episodes: Int[Array, "*batch"]
    loss: Float[Array, "*batch"]
    average: Weights | None = None
    epsilon_share: Float[Array, "*batch"] | None = None
    episode: RunningEpisode | None = None

    @property
    def policy_weights(self) -> Weights:
        """What the greedy policy is made from."""
        return self.weights if self.average is None else self.average

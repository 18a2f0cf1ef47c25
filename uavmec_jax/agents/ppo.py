"""Proximal policy optimisation (PPO) for one agent, with the defaults of Stable-Baselines3, the library of the paper."""

from dataclasses import dataclass, field, replace
from functools import partial

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from uavmec_jax.agents import actor_critic
from uavmec_jax.agents.actor_critic import ActorCriticHyper, ActorCriticSpec, ActorCriticState
from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.agents.collect_rollout import Samples, collect_rollout
from uavmec_jax.agents.gae import log_prob_and_entropy, normalize
from uavmec_jax.agents.networks import Weights
from uavmec_jax.agents.optimizers import TrainState, apply_gradients, clipped_adam
from uavmec_jax.agents.shuffle import permutation
from uavmec_jax.env.types import Scalar

_OPTIMIZER = clipped_adam(eps=1e-5)


@struct.dataclass
class PPOHyper(ActorCriticHyper):
    """Hyperparameters that may differ between agents of one program (traced)."""

    clip_range: Scalar = struct.field(default=0.2, metadata={"gt": 0})
    """Distance from 1 at which the probability ratio is clipped."""
    learning_rate_decay: Scalar = struct.field(default=1.0, metadata={"gt": 0, "le": 1})
    """Learning rate at the end of training divided by that at its beginning; it falls geometrically."""


@dataclass(frozen=True)
class PPOSpec(ActorCriticSpec):
    """Static settings, which shape the program."""

    batch_size: int = field(default=64, metadata={"ge": 1, "le": 100_000_000})
    """Size of a minibatch; it divides ``n_steps * n_envs``."""
    n_epochs: int = field(default=10, metadata={"ge": 1, "le": 1000})
    """Passes over each rollout."""

    @property
    def minibatches(self) -> int:
        """Gradient steps of one epoch."""
        return self.steps_per_iteration // self.batch_size


def algorithm(spec: PPOSpec) -> Algorithm:
    """Return the algorithm with its static settings bound.

    Raises:
        ValueError: the minibatch does not divide the rollout.
    """
    if spec.steps_per_iteration % spec.batch_size:
        raise ValueError(
            f"batch_size is {spec.batch_size}; it should divide n_steps * n_envs = {spec.steps_per_iteration}"
        )
    return actor_critic.make_algorithm("ppo", spec, _OPTIMIZER, partial(_iteration, spec))


def ppo_loss(spec: PPOSpec, hyper: PPOHyper, weights: Weights, batch: Samples) -> Float[Array, ""]:
    """Return the loss of a minibatch: clipped surrogate, squared value error, entropy (Schulman et al., 2017, eq. 9)."""
    advantage = normalize(batch.advantage, hyper.normalize_advantage)
    logits, values = actor_critic.logits_and_value(spec, hyper, weights, batch.observation)
    log_prob, entropy = log_prob_and_entropy(logits, batch.action)
    chex.assert_equal_shape([log_prob, batch.log_prob, advantage, batch.returns, values])
    ratio = jnp.exp(log_prob - batch.log_prob)
    clipped = jnp.clip(ratio, 1.0 - hyper.clip_range, 1.0 + hyper.clip_range)
    surrogate = jnp.mean(jnp.minimum(advantage * ratio, advantage * clipped))
    value_loss = jnp.mean(jnp.square(batch.returns - values))
    return hyper.vf_coef * value_loss - surrogate - hyper.ent_coef * jnp.mean(entropy)


def _iteration(spec: PPOSpec, agent: Agent, state: ActorCriticState, i: Int[Array, ""]) -> ActorCriticState:
    """Play a rollout, then make ``n_epochs`` passes over it, each in a new random order."""
    rollout_key, *epoch_keys = jax.random.split(jax.random.fold_in(agent.key, i), 1 + spec.n_epochs)
    state, samples = collect_rollout(spec, agent, state, rollout_key)
    updates_done = i * spec.n_epochs * spec.minibatches
    steps_done = (i + 1) * spec.steps_per_iteration
    rows = _rows(samples)
    decay = agent.hyper.learning_rate_decay ** (i / spec.iterations)
    hyper = replace(agent.hyper, learning_rate=agent.hyper.learning_rate * decay)

    def epoch(
        carry: tuple[TrainState, Array], numbered: tuple[Array, PRNGKeyArray]
    ) -> tuple[tuple[TrainState, Array], None]:
        number, key = numbered
        shuffled = rows[permutation(key, rows.shape[0])]
        count = updates_done + number * spec.minibatches + 1
        return train_epoch(spec, hyper, carry[0], shuffled, count, steps_done), None

    numbered = (jnp.arange(spec.n_epochs), jnp.stack(epoch_keys))
    (train_state, loss), _ = jax.lax.scan(epoch, (state.train_state, state.loss), numbered)
    return state.with_train_state(train_state, loss)


def train_epoch(
    spec: PPOSpec,
    hyper: PPOHyper,
    train_state: TrainState,
    rows: Float[Array, "size row"],
    count: int | Int[Array, ""],
    steps_done: int | Int[Array, ""],
) -> tuple[TrainState, Float[Array, ""]]:
    """Make a gradient step on each minibatch, in the order of the rows, and return the last loss, too.

    Args:
        spec: static settings.
        hyper: hyperparameters.
        train_state: weights and optimiser state before the epoch.
        rows: the samples, one row each, already shuffled.
        count: number of the first of these gradient steps, from 1.
        steps_done: environment steps of the agent so far.
    """
    batches = rows.reshape(spec.minibatches, spec.batch_size, -1)

    def gradient_step(
        carry: tuple[TrainState, Array], numbered: tuple[Array, Array]
    ) -> tuple[tuple[TrainState, Array], None]:
        number, batch = numbered
        loss, gradient = jax.value_and_grad(lambda w: ppo_loss(spec, hyper, w, _samples(batch)))(carry[0].weights)
        train_state = apply_gradients(
            _OPTIMIZER,
            carry[0],
            loss,
            gradient,
            learning_rate=hyper.learning_rate,
            max_norm=hyper.max_grad_norm,
            count=count + number,
            steps_done=steps_done,
        )
        return (train_state, loss), None

    return jax.lax.scan(gradient_step, (train_state, jnp.float32(0)), (jnp.arange(spec.minibatches), batches))[0]


def _rows(samples: Samples) -> Float[Array, "size row"]:
    """Pack each sample into one row, so that a shuffle moves whole rows."""
    action = jax.lax.bitcast_convert_type(samples.action, jnp.float32)
    return jnp.concatenate(
        [samples.observation, jnp.stack([action, samples.advantage, samples.returns, samples.log_prob], axis=-1)],
        axis=-1,
    )


def _samples(rows: Float[Array, "b row"]) -> Samples:
    """Unpack the samples of rows."""
    action = jax.lax.bitcast_convert_type(rows[:, -4], jnp.int32)
    return Samples(rows[:, :-4], action, rows[:, -3], rows[:, -2], rows[:, -1])

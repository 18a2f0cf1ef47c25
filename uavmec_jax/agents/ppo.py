"""Proximal policy optimisation with the defaults of Stable-Baselines3, the library of the paper: one agent."""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from uavmec_jax.agents import on_policy
from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.agents.collect_rollout import Samples, collect_rollout
from uavmec_jax.agents.gae import log_probability, normalized
from uavmec_jax.agents.on_policy import OnPolicyHyper, OnPolicySpec, OnPolicyState
from uavmec_jax.agents.optimizers import TrainState, apply_gradients, clipped_adam

_OPTIMIZER = clipped_adam(eps=1e-5)


@struct.dataclass
class PPOHyper(OnPolicyHyper):
    """Hyperparameters that may differ between agents of one program (traced)."""

    clip_range: Any = struct.field(default=0.2, metadata={"gt": 0})
    """How far the probability ratio may leave 1."""
    learning_rate_decay: Any = struct.field(default=1.0, metadata={"gt": 0, "le": 1})
    """Learning rate at the end of training over the one at its beginning; it falls geometrically."""


@dataclass(frozen=True)
class PPOSpec(OnPolicySpec):
    """What shapes the program (static)."""

    batch_size: int = field(default=64, metadata={"ge": 1})
    """Minibatch; divides ``n_steps * n_envs``."""
    n_epochs: int = field(default=10, metadata={"ge": 1, "le": 1000})
    """Passes over each rollout."""

    @property
    def minibatches(self) -> int:
        """Gradient steps of one epoch."""
        return self.steps_per_iteration // self.batch_size


def algorithm(spec: PPOSpec) -> Algorithm:
    """Bind the static settings.

    Raises:
        ValueError: the minibatch does not divide the rollout.
    """
    if spec.steps_per_iteration % spec.batch_size:
        raise ValueError(
            f"batch_size is {spec.batch_size}; it should divide n_steps * n_envs = {spec.steps_per_iteration}"
        )
    return on_policy.bind("ppo", spec, _OPTIMIZER, partial(_iteration, spec))


def ppo_loss(spec: PPOSpec, hyper: PPOHyper, weights: Any, batch: Samples) -> Float[Array, ""]:
    """Clipped surrogate, squared value error and entropy of a minibatch ``[B]`` (Schulman et al., 2017, equation 9)."""
    advantage = normalized(batch.advantage, hyper.normalize_advantage)
    scores, values = on_policy.both(spec, hyper, weights, batch.observation)
    log_prob, entropy = log_probability(scores, batch.action)
    ratio = jnp.exp(log_prob - batch.log_prob)
    clipped = jnp.clip(ratio, 1.0 - hyper.clip_range, 1.0 + hyper.clip_range)
    surrogate = jnp.mean(jnp.minimum(advantage * ratio, advantage * clipped))
    error = jnp.mean(jnp.square(batch.returns - values))
    return hyper.vf_coef * error - surrogate - hyper.ent_coef * jnp.mean(entropy)


def _iteration(spec: PPOSpec, agent: Agent, state: OnPolicyState, i: Any) -> OnPolicyState:
    """A rollout, then ``n_epochs`` passes over it in fresh random orders."""
    play_key, *epoch_keys = jax.random.split(jax.random.fold_in(agent.key, i), 1 + spec.n_epochs)
    state, samples = collect_rollout(spec, agent, state, play_key)
    updates_done = i * spec.n_epochs * spec.minibatches
    steps_done = (i + 1) * spec.steps_per_iteration
    rows = _rows(samples)
    decay = agent.hyper.learning_rate_decay ** (i / spec.iterations)
    hyper = replace(agent.hyper, learning_rate=agent.hyper.learning_rate * decay)

    def epoch(carry: tuple[TrainState, Array], numbered: tuple[Any, Any]) -> tuple[tuple[TrainState, Array], None]:
        number, key = numbered
        shuffled = rows[_permutation(key, rows.shape[0])]
        count = updates_done + number * spec.minibatches + 1
        return learn(spec, hyper, carry[0], shuffled, count, steps_done), None

    numbered = (jnp.arange(spec.n_epochs), jnp.stack(epoch_keys))
    (train_state, loss), _ = jax.lax.scan(epoch, (state.train_state, state.loss), numbered)
    return state.after(train_state, loss)


def learn(
    spec: PPOSpec,
    hyper: PPOHyper,
    train_state: TrainState,
    rows: Float[Array, "size words"],
    count: Any,
    steps_done: Any,
) -> tuple[TrainState, Float[Array, ""]]:
    """One epoch: a gradient step on each minibatch in the order of the rows; ``count`` numbers the first of them."""
    batches = rows.reshape(spec.minibatches, spec.batch_size, -1)

    def step(carry: tuple[TrainState, Array], numbered: tuple[Any, Array]) -> tuple[tuple[TrainState, Array], None]:
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

    return jax.lax.scan(step, (train_state, jnp.float32(0)), (jnp.arange(spec.minibatches), batches))[0]


def _permutation(key: Any, size: int) -> Array:
    """A random order: the ranks of random words. (Two equal words, once in 2,000 orders of 2,048, keep their order.)"""
    return jax.lax.sort_key_val(jax.random.bits(key, (size,)), jnp.arange(size))[1]


def _rows(samples: Samples) -> Float[Array, "size words"]:
    """Samples as one row of words each, so that a shuffle moves whole rows."""
    action = jax.lax.bitcast_convert_type(samples.action, jnp.float32)
    return jnp.concatenate(
        [samples.observation, jnp.stack([action, samples.advantage, samples.returns, samples.log_prob], axis=-1)],
        axis=-1,
    )


def _samples(rows: Float[Array, "b words"]) -> Samples:
    """The samples of rows."""
    action = jax.lax.bitcast_convert_type(rows[:, -4], jnp.int32)
    return Samples(rows[:, :-4], action, rows[:, -3], rows[:, -2], rows[:, -1])

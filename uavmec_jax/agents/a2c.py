"""Advantage actor-critic with the defaults of Stable-Baselines3, the library of the paper: one agent."""

from dataclasses import dataclass, field
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
from uavmec_jax.agents.optimizers import TrainState, apply_gradients, clipped_rmsprop

_OPTIMIZER = clipped_rmsprop(decay=0.99, eps=1e-5)


@struct.dataclass
class A2CHyper(OnPolicyHyper):
    """Hyperparameters that may differ between agents of one program (traced)."""

    learning_rate: Any = struct.field(default=7e-4, metadata={"gt": 0})
    gae_lambda: Any = struct.field(default=1.0, metadata={"ge": 0, "le": 1})
    normalize_advantage: Any = False
    """Whether generalized_advantages are normalised within each rollout."""


@dataclass(frozen=True)
class A2CSpec(OnPolicySpec):
    """What shapes the program (static)."""

    n_steps: int = field(default=5, metadata={"ge": 1, "le": 1_000_000})
    """Slots played in each environment between updates."""


def algorithm(spec: A2CSpec) -> Algorithm:
    """Bind the static settings."""
    return on_policy.bind("a2c", spec, _OPTIMIZER, partial(_iteration, spec))


def a2c_loss(spec: A2CSpec, hyper: A2CHyper, weights: Any, samples: Samples) -> Float[Array, ""]:
    """Policy gradient, squared value error and entropy of a rollout ``[B]`` (Mnih et al., 2016, section 4)."""
    advantage = normalized(samples.advantage, hyper.normalize_advantage)
    scores, values = on_policy.both(spec, hyper, weights, samples.observation)
    log_prob, entropy = log_probability(scores, samples.action)
    error = jnp.mean(jnp.square(samples.returns - values))
    return hyper.vf_coef * error - jnp.mean(advantage * log_prob) - hyper.ent_coef * jnp.mean(entropy)


def learn(
    spec: A2CSpec, hyper: A2CHyper, train_state: TrainState, samples: Samples, steps_done: Any
) -> tuple[TrainState, Float[Array, ""]]:
    """One gradient step on a whole rollout."""
    loss, gradient = jax.value_and_grad(lambda w: a2c_loss(spec, hyper, w, samples))(train_state.weights)
    after = apply_gradients(
        _OPTIMIZER,
        train_state,
        loss,
        gradient,
        learning_rate=hyper.learning_rate,
        max_norm=hyper.max_grad_norm,
        count=steps_done // spec.steps_per_iteration,
        steps_done=steps_done,
    )
    return after, loss


def _iteration(spec: A2CSpec, agent: Agent, state: OnPolicyState, i: Any) -> OnPolicyState:
    """A rollout and one gradient step."""
    state, samples = collect_rollout(spec, agent, state, jax.random.fold_in(agent.key, i))
    return state.after(*learn(spec, agent.hyper, state.train_state, samples, (i + 1) * spec.steps_per_iteration))

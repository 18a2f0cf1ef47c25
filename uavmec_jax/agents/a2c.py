"""Advantage actor-critic (A2C) for one agent, with the defaults of Stable-Baselines3, the library of the paper."""

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from uavmec_jax.agents import actor_critic
from uavmec_jax.agents.actor_critic import ActorCriticHyper, ActorCriticSpec, ActorCriticState
from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.agents.collect_rollout import Samples, collect_rollout
from uavmec_jax.agents.gae import log_prob_and_entropy, normalize
from uavmec_jax.agents.networks import Weights
from uavmec_jax.agents.optimizers import TrainState, apply_gradients, clipped_rmsprop
from uavmec_jax.env.types import Scalar

_OPTIMIZER = clipped_rmsprop(decay=0.99, eps=1e-5)


@struct.dataclass
class A2CHyper(ActorCriticHyper):
    """Hyperparameters that may differ between agents of one program (traced)."""

    learning_rate: Scalar = struct.field(default=7e-4, metadata={"gt": 0})
    gae_lambda: Scalar = struct.field(default=1.0, metadata={"ge": 0, "le": 1})
    normalize_advantage: Scalar = False
    """Whether advantages are normalised within each rollout."""


@dataclass(frozen=True)
class A2CSpec(ActorCriticSpec):
    """Static settings, which shape the program."""

    n_steps: int = field(default=5, metadata={"ge": 1, "le": 1_000_000})
    """Slots played in each environment between updates."""


def algorithm(spec: A2CSpec) -> Algorithm:
    """Return the algorithm with its static settings bound."""
    return actor_critic.make_algorithm("a2c", spec, _OPTIMIZER, partial(_iteration, spec))


def a2c_loss(spec: A2CSpec, hyper: A2CHyper, weights: Weights, samples: Samples) -> Float[Array, ""]:
    """Return the loss of a rollout: policy gradient, squared value error, entropy (Mnih et al., 2016, section 4)."""
    advantage = normalize(samples.advantage, hyper.normalize_advantage)
    logits, values = actor_critic.logits_and_value(spec, hyper, weights, samples.observation)
    log_prob, entropy = log_prob_and_entropy(logits, samples.action)
    value_loss = jnp.mean(jnp.square(samples.returns - values))
    return hyper.vf_coef * value_loss - jnp.mean(advantage * log_prob) - hyper.ent_coef * jnp.mean(entropy)


def gradient_step(
    spec: A2CSpec, hyper: A2CHyper, train_state: TrainState, samples: Samples, steps_done: int | Int[Array, ""]
) -> tuple[TrainState, Float[Array, ""]]:
    """Make one gradient step on a whole rollout and return its loss, too."""
    loss, gradient = jax.value_and_grad(lambda w: a2c_loss(spec, hyper, w, samples))(train_state.weights)
    train_state = apply_gradients(
        _OPTIMIZER,
        train_state,
        loss,
        gradient,
        learning_rate=hyper.learning_rate,
        max_norm=hyper.max_grad_norm,
        count=steps_done // spec.steps_per_iteration,
        steps_done=steps_done,
    )
    return train_state, loss


def _iteration(spec: A2CSpec, agent: Agent, state: ActorCriticState, i: Int[Array, ""]) -> ActorCriticState:
    """Play a rollout and make one gradient step."""
    state, samples = collect_rollout(spec, agent, state, jax.random.fold_in(agent.key, i))
    steps_done = (i + 1) * spec.steps_per_iteration
    return state.with_train_state(*gradient_step(spec, agent.hyper, state.train_state, samples, steps_done))

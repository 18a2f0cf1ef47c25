"""Rewards: weight vectors over eight terms, the eleven of Table 6 by name (paper, section 3.2 and Table 6)."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Float, Int

from uavmec_jax.env.dynamics import Outcome, State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.types import Scalar

TERMS: tuple[str, ...] = ("A", "U", "M", "O", "log A", "log U", "log M", "log O")
"""The terms of a reward, in the order of a weight vector.

A: data age of the visited device before the visit. U: slots completed, this one included. M: lowest battery fraction
after the slot. O: oldest data age before the visit.
"""

LOG_GUARDS: tuple[str, ...] = ("clamp", "log1p")
"""How the logarithms treat zero: ``clamp`` is log(max(x, 1e-6)); ``log1p`` is log(x + 1) for the ages A and O."""

_SMALLEST = 1e-6


def make_weights(terms: Mapping[str, float]) -> np.ndarray:
    """Turn ``{"U": 1.0, "log A": 1.0}`` into a weight vector ``[8]``.

    Raises:
        ValueError: a term is not one of :data:`TERMS`, or a weight is not finite.
    """
    weights = np.zeros(len(TERMS), np.float32)
    for term, weight in terms.items():
        if term not in TERMS:
            raise ValueError(f"unknown reward term {term!r}; terms are {', '.join(TERMS)}")
        if not np.isfinite(weight):
            raise ValueError(f"weight of reward term {term!r} is {weight}; it must be a finite number")
        weights[TERMS.index(term)] = weight
    weights.setflags(write=False)
    return weights


DEFAULT_REWARD = "U+log(A/O)"
"""The reward that the paper found best, the last row of Table 6."""

REWARDS: Mapping[str, np.ndarray] = MappingProxyType(
    {
        "A": make_weights({"A": 1}),
        "U": make_weights({"U": 1}),
        "M": make_weights({"M": 1}),
        "-O": make_weights({"O": -1}),
        "A+U+M-O": make_weights({"A": 1, "U": 1, "M": 1, "O": -1}),
        "log A": make_weights({"log A": 1}),
        "log U": make_weights({"log U": 1}),
        "log M": make_weights({"log M": 1}),
        "-log O": make_weights({"log O": -1}),
        "log A+log U+log M-log O": make_weights({"log A": 1, "log U": 1, "log M": 1, "log O": -1}),
        DEFAULT_REWARD: make_weights({"U": 1, "log A": 1, "log O": -1}),
    }
)
"""The eleven rewards of Table 6: name -> weights ``[8]`` over :data:`TERMS`."""


@struct.dataclass
class Reward:
    """A reward: linear in the terms, or any function of them.

    Attributes:
        weights: weights of the :data:`TERMS`.
        log1p: bool, the guard of the logarithms; see :data:`LOG_GUARDS`.
        function: a function from ``{term: scalar}`` to a scalar that replaces the weighted sum, or ``None``; static.
        traffic_bonus: added when a device in the densest traffic is visited, proportionally less for a device in
            lighter traffic (paper, section 5.1).
        traffic_penalty: subtracted, in the same proportion, for the device that fails first.
        per_slot: added for every slot that counts; alone, it makes the sum of the rewards the lifetime.
    """

    weights: Float[Array, "*batch 8"]
    log1p: Scalar = False
    function: Callable[[Mapping[str, Any]], Any] | None = struct.field(pytree_node=False, default=None)
    traffic_bonus: Scalar = 0.0
    traffic_penalty: Scalar = 0.0
    per_slot: Scalar = 0.0


def make_reward(
    reward: str | Mapping[str, float] | Callable[[Mapping[str, Any]], Any] = DEFAULT_REWARD,
    guard: str = "clamp",
    *,
    traffic_bonus: float = 0.0,
    traffic_penalty: float = 0.0,
    per_slot: float = 0.0,
) -> Reward:
    """Make a :class:`Reward` from a name of Table 6, from custom weights, or from a function.

    Args:
        reward: a name such as ``"U+log(A/O)"``; weights such as ``{"U": 1.0, "log A": 1.0}``; or a traceable function
            from ``{term: scalar}`` to a scalar, such as ``lambda terms: terms["U"] * terms["M"]``.
        guard: one of :data:`LOG_GUARDS`.
        traffic_bonus: see :class:`Reward`; it has an effect in layouts with traffic.
        traffic_penalty: likewise.
        per_slot: added for every slot that counts; ``make_reward({}, per_slot=1.0)`` is the lifetime.

    Raises:
        ValueError: the name, a term or the guard is unknown, or the function does not return a scalar.
    """
    if guard not in LOG_GUARDS:
        raise ValueError(f"unknown log guard {guard!r}; guards are {', '.join(LOG_GUARDS)}")
    common = {
        "log1p": jnp.asarray(guard == "log1p"),
        "traffic_bonus": jnp.float32(traffic_bonus),
        "traffic_penalty": jnp.float32(traffic_penalty),
        "per_slot": jnp.float32(per_slot),
    }
    if callable(reward):
        _check_function(reward)
        return Reward(weights=jnp.zeros(len(TERMS)), function=reward, **common)
    if isinstance(reward, str):
        if reward not in REWARDS:
            raise ValueError(f"unknown reward {reward!r}; rewards are {', '.join(REWARDS)}")
        weights = REWARDS[reward]
    else:
        weights = make_weights(reward)
    return Reward(weights=jnp.asarray(weights), **common)


def _check_function(function: Callable[[Mapping[str, Any]], Any]) -> None:
    """Check that a reward function asks for known terms only and returns a scalar."""
    scalar = jax.ShapeDtypeStruct((), jnp.float32)
    try:
        result = jax.eval_shape(lambda terms: jnp.asarray(function(terms)), dict.fromkeys(TERMS, scalar))
    except KeyError as error:
        raise ValueError(f"the reward function asks for the term {error}; terms are {', '.join(TERMS)}") from None
    if result.shape != ():
        raise ValueError(f"the reward function returns an array of shape {result.shape}; it should return a scalar")


def needs_guard(reward: str | Mapping[str, float]) -> bool:
    """Return whether the guard makes a difference to a reward: only ``log A`` and ``log O`` depend on it."""
    weights = REWARDS[reward] if isinstance(reward, str) else make_weights(reward)
    return bool(weights[TERMS.index("log A")] or weights[TERMS.index("log O")])


def reward_terms(
    layout: Layout, before: State, action: Int[ArrayLike, ""], after: State, log1p: Scalar = False
) -> Float[Array, "8"]:
    """Return the eight :data:`TERMS` of one slot from the states before and after it."""
    visited_age = before.age[action].astype(jnp.float32)
    oldest_age = jnp.max(before.age).astype(jnp.float32)
    slots = after.slot.astype(jnp.float32)
    lowest_battery = jnp.min(after.battery / layout.capacity)
    plain = jnp.stack([visited_age, slots, lowest_battery, oldest_age])
    is_age = np.array([True, False, False, True])
    guarded = jnp.where(log1p & is_age, plain + 1.0, jnp.maximum(plain, _SMALLEST))
    return jnp.concatenate([plain, jnp.log(guarded)])


def reward_of(
    reward: Reward, layout: Layout, before: State, action: Int[ArrayLike, ""], after: State
) -> Float[Array, ""]:
    """Return the reward of one slot, without traffic."""
    terms = reward_terms(layout, before, action, after, reward.log1p)
    survival = reward.per_slot * (after.slot - before.slot)
    if reward.function is not None:
        return jnp.asarray(reward.function(dict(zip(TERMS, terms, strict=True))), jnp.float32) + survival
    return jnp.dot(reward.weights, terms) + survival


def traffic_reward(
    reward: Reward, layout: Layout, before: State, action: Int[ArrayLike, ""], outcome: Outcome
) -> Float[Array, ""]:
    """Return what traffic adds to the reward of one slot; 0 for a layout without traffic.

    It is ``traffic_bonus * w[action] - traffic_penalty * sum(first_failure * w)``, where ``w`` are the devices' traffic
    weights when the slot begins.
    """
    if layout.traffic is None:
        return jnp.zeros(())
    weight = layout.traffic.at(before.elapsed)
    failed_weight = jnp.dot(outcome.first_failure, weight)
    return jnp.asarray(reward.traffic_bonus * weight[action] - reward.traffic_penalty * failed_weight, jnp.float32)

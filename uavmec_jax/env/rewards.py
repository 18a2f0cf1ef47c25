"""Rewards: weight vectors over eight terms, the eleven of Table 6 by name (paper, section 3.2 and Table 6)."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from uavmec_jax.env.checks import Bounds, Check, check_range, check_ranges
from uavmec_jax.env.dynamics import Outcome, State, complete_state, living_devices, service
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.products import product
from uavmec_jax.env.types import Scalar
from uavmec_jax.errors import ArgumentError

TERMS: tuple[str, ...] = ("A", "U", "M", "O", "log A", "log U", "log M", "log O")
"""The terms of a reward, in the order of a weight vector.

A: data age of the visited device before the visit, of a fleet the largest one. U: slots completed, this one included. M:
lowest battery fraction after the slot. O: oldest data age before the visit. Devices whose battery was empty before the slot
count in none of them.
"""

SERVICE_TERM = "S"
"""A ninth term: the share of the devices that work and whose data are fresh after the slot, weighted by priority."""

LOG_GUARDS: tuple[str, ...] = ("clamp", "log1p")
"""How the logarithms treat zero: ``clamp`` is log(max(x, 1e-6)); ``log1p`` is log(x + 1) for the ages A and O."""

_SMALLEST = 1e-6


def make_weights(terms: Mapping[str, float]) -> np.ndarray:
    """Turn ``{"U": 1.0, "log A": 1.0}`` into a weight vector ``[8]``.

    Raises:
        ArgumentError: a term is not one of :data:`TERMS`, or a weight is not finite.
    """
    weights = np.zeros(len(TERMS), np.float32)
    for term, weight in terms.items():
        if term not in TERMS:
            raise ArgumentError(f"unknown reward term {term!r}; terms are {', '.join((*TERMS, SERVICE_TERM))}")
        weights[TERMS.index(term)] = _finite(term, weight)
    weights.setflags(write=False)
    return weights


def _finite(term: str, weight: float) -> float:
    """Return the weight of a term, which has to be a number that is finite in single precision."""
    name = f"weight of reward term {term!r}"
    check_range(name, weight)
    if np.ndim(weight):
        raise ArgumentError(f"{name} is {weight!r}; it should be a finite number")
    return weight


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
        service: weight of the term :data:`SERVICE_TERM`; ``None``: it is not computed.
    """

    weights: Float[Array, "*batch 8"]
    log1p: Scalar = False
    function: Callable[[Mapping[str, Any]], Any] | None = struct.field(pytree_node=False, default=None)
    traffic_bonus: Scalar = 0.0
    traffic_penalty: Scalar = 0.0
    per_slot: Scalar = 0.0
    service: Scalar | None = None


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
        reward: a name such as ``"U+log(A/O)"``; weights such as ``{"U": 1.0, "log A": 1.0, "S": 2.0}``; or a traceable
            function from ``{term: scalar}`` to a scalar, such as ``lambda terms: terms["U"] * terms["M"]``.
        guard: one of :data:`LOG_GUARDS`.
        traffic_bonus: see :class:`Reward`; it has an effect in layouts with traffic.
        traffic_penalty: likewise.
        per_slot: added for every slot that counts; ``make_reward({}, per_slot=1.0)`` is the lifetime.

    Raises:
        ArgumentError: the name, a term or the guard is unknown, a number is not finite, or the function does not return a
            scalar.
    """
    if guard not in LOG_GUARDS:
        raise ArgumentError(f"unknown log guard {guard!r}; guards are {', '.join(LOG_GUARDS)}")
    numbers = {"traffic_bonus": traffic_bonus, "traffic_penalty": traffic_penalty, "per_slot": per_slot}
    check_ranges([Check(name, value, Bounds()) for name, value in numbers.items()])
    common = {
        "log1p": jnp.asarray(guard == "log1p"),
        "traffic_bonus": jnp.float32(traffic_bonus),
        "traffic_penalty": jnp.float32(traffic_penalty),
        "per_slot": jnp.float32(per_slot),
    }
    if callable(reward):
        _check_function(reward)
        return Reward(weights=jnp.zeros(len(TERMS)), function=reward, **common)
    service = None
    if isinstance(reward, str):
        if reward not in REWARDS:
            raise ArgumentError(f"unknown reward {reward!r}; rewards are {', '.join(REWARDS)}")
        weights = REWARDS[reward]
    elif not isinstance(reward, Mapping):
        raise ArgumentError(f"reward is {reward!r}; it should be a name, weights of terms, or a function")
    else:
        weights = make_weights({term: weight for term, weight in reward.items() if term != SERVICE_TERM})
        if SERVICE_TERM in reward:
            service = jnp.float32(_finite(SERVICE_TERM, reward[SERVICE_TERM]))
    return Reward(weights=jnp.asarray(weights), service=service, **common)


def _check_function(function: Callable[[Mapping[str, Any]], Any]) -> None:
    """Check that a reward function asks for known terms only and returns a scalar."""
    scalar = jax.ShapeDtypeStruct((), jnp.float32)
    try:
        terms = dict.fromkeys((*TERMS, SERVICE_TERM), scalar)
        result = jax.eval_shape(lambda terms: jnp.asarray(function(terms)), terms)
    except KeyError as error:
        known = ", ".join((*TERMS, SERVICE_TERM))
        raise ArgumentError(f"the reward function asks for the term {error}; terms are {known}") from None
    if result.shape != ():
        raise ArgumentError(f"the reward function returns an array of shape {result.shape}; it should return a scalar")


def needs_guard(reward: str | Mapping[str, float]) -> bool:
    """Return whether the guard makes a difference to a reward: only ``log A`` and ``log O`` depend on it."""
    if isinstance(reward, str):
        weights = REWARDS[reward]
    else:
        weights = make_weights({term: weight for term, weight in reward.items() if term != SERVICE_TERM})
    return bool(weights[TERMS.index("log A")] or weights[TERMS.index("log O")])


def check_reward(reward: Reward) -> None:
    """Check that all numbers of a reward that are known are finite.

    Raises:
        ArgumentError: one line.
    """
    names = ("weights", "traffic_bonus", "traffic_penalty", "per_slot", "service")
    given = {name: getattr(reward, name) for name in names if getattr(reward, name) is not None}
    check_ranges([Check(f"reward.{name}", value, Bounds()) for name, value in given.items()])


def check_guard(reward: Reward, layout: Layout) -> None:
    """Check that a reward has no bare logarithm of an age if there are depots; traced rewards pass.

    Raises:
        ArgumentError: one line.
    """
    if not layout.n_depots or isinstance(reward.weights, jax.core.Tracer) or isinstance(reward.log1p, jax.core.Tracer):
        return
    ages = np.asarray(reward.weights)[..., [TERMS.index("log A"), TERMS.index("log O")]]
    if np.any(np.any(ages != 0, axis=-1) & ~np.asarray(reward.log1p)):
        raise ArgumentError(
            "the reward has log A or log O and the guard clamp, but with depots A is 0 when every UAV is at one; "
            "give guard='log1p'"
        )


def reward_terms(
    layout: Layout,
    before: State,
    action: Int[ArrayLike, ""] | Int[Array, " K"],
    after: State,
    log1p: Scalar = False,
    living: Bool[Array, " n"] | None = None,
) -> Float[Array, "8"]:
    """Return the eight :data:`TERMS` of one slot from the states before and after it.

    ``living`` are the devices that worked when the slot began; ``None``: all did.
    """
    visited_age = _largest_at_targets(layout, before, action, before.age, living).astype(jnp.float32)
    counted = lambda value, otherwise: value if living is None else jnp.where(living, value, otherwise)  # noqa: E731
    oldest_age = jnp.max(counted(before.age, 0)).astype(jnp.float32)
    slots = after.slot.astype(jnp.float32)
    lowest_battery = jnp.min(counted(after.battery / layout.capacity, jnp.inf))
    if living is not None:
        lowest_battery = jnp.where(jnp.any(living), lowest_battery, 0.0)
    plain = jnp.stack([visited_age, slots, lowest_battery, oldest_age])
    is_age = np.array([True, False, False, True])
    guarded = jnp.where(log1p & is_age, plain + 1.0, jnp.maximum(plain, _SMALLEST))
    return jnp.concatenate([plain, jnp.log(guarded)])


def _largest_at_targets(
    layout: Layout,
    before: State,
    action: Int[ArrayLike, ""] | Int[Array, " K"],
    value: Num[Array, " n"],
    living: Bool[Array, " n"] | None,
) -> Num[Array, ""]:
    """Return the largest value among the living devices that UAVs fly to, able to pay or not; 0 without any."""
    n, target = layout.n_devices, jnp.clip(jnp.atleast_1d(action), 0, layout.n_places - 1)
    if layout.n_uavs == 1 and not layout.n_depots and living is None:
        return value[target[0]]
    counts = (target < n) & ~complete_state(layout, before).grounded
    device = jnp.clip(target, 0, n - 1)
    counts = counts if living is None else counts & living[device]
    return jnp.max(jnp.where(counts, value[device], 0))


def reward_of(
    reward: Reward,
    layout: Layout,
    before: State,
    action: Int[ArrayLike, ""] | Int[Array, " K"],
    after: State,
    params: Params | None = None,
) -> Float[Array, ""]:
    """Return the reward of one slot, without traffic; all UAVs share it. By default, ``params`` are the paper's."""
    params = Params() if params is None else params
    terms = reward_terms(layout, before, action, after, reward.log1p, living_devices(params, layout, before))
    survival = reward.per_slot * (after.slot - before.slot)
    if reward.function is not None:
        named = dict(zip(TERMS, terms, strict=True)) | {SERVICE_TERM: service(params, layout, after)}
        return jnp.asarray(reward.function(named), jnp.float32) + survival
    total = product(reward.weights, terms) + survival
    return total if reward.service is None else total + reward.service * service(params, layout, after)


def traffic_reward(
    reward: Reward,
    layout: Layout,
    before: State,
    action: Int[ArrayLike, ""] | Int[Array, " K"],
    outcome: Outcome,
    living: Bool[Array, " n"] | None = None,
) -> Float[Array, ""]:
    """Return what traffic adds to the reward of one slot; 0 for a layout without traffic.

    It is ``traffic_bonus * w[action] - traffic_penalty * sum(first_failure * w)``, where ``w`` are the devices' traffic
    weights when the slot begins; of the targets of a fleet the largest weight counts.
    """
    if layout.traffic is None:
        return jnp.zeros(())
    weight = layout.traffic.at(before.elapsed)
    failed_weight = product(outcome.first_failure, weight)
    visited_weight = _largest_at_targets(layout, before, action, weight, living)
    return jnp.asarray(reward.traffic_bonus * visited_weight - reward.traffic_penalty * failed_weight, jnp.float32)

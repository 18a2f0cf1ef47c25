"""Advice for the next slot: whom to visit, how long the network will last, and which device will fail first.

Whatever policy is asked, every device is tried as the next visit, and many futures are played to their end with the policy
going on. It is the rollout planner's step (:mod:`uavmec_jax.planning.rollout_planner`) with so many futures that their
distribution is worth showing.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from uavmec_jax.env.dynamics import Cause, State, initial_state
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode, Policy, play_on
from uavmec_jax.planning.changes import WhatIf, every_change, rank_changes

SAMPLES = 256
"""Futures played for each device that could be visited next."""


@dataclass(frozen=True)
class Candidate:
    """One device as the next visit.

    Attributes:
        device: index from 0.
        lifetime: slots, mean over the futures in which it is visited next and the policy goes on.
        behind: slots that the best candidate is worth more, on the same futures: lives, less the price of the first
            failure where the traffic has one.
        behind_low, behind_high: 95 % interval of that difference over the futures.
    """

    device: int
    lifetime: float
    behind: float
    behind_low: float
    behind_high: float


@dataclass(frozen=True)
class Advice:
    """What is to be done and to be expected in one state; ``S`` futures.

    Attributes:
        chosen: index of the device to visit next.
        of_policy: index of the device that the policy itself would visit.
        candidates: every device, the best first.
        lifetimes: ``[S]`` slots from the first slot on, those already survived included.
        first_failure: ``[n]`` probability of each device to be the first to fail; what is missing to 1 is the UAV's share.
        failure_slot: ``[n]`` slot in which each device fails, mean over the futures in which it is the first; NaN if never.
        causes: how often the end comes by each :class:`Cause`.
        what_if: every repair and removal of one device, the most useful first; empty if not asked for.
    """

    chosen: int
    of_policy: int
    candidates: tuple[Candidate, ...]
    lifetimes: np.ndarray
    first_failure: np.ndarray
    failure_slot: np.ndarray
    causes: Mapping[Cause, float]
    what_if: tuple[WhatIf, ...] = ()

    @property
    def interval(self) -> tuple[float, float]:
        """Slots between which 95 % of the futures end."""
        low, high = np.percentile(self.lifetimes, [2.5, 97.5])
        return float(low), float(high)


def advise(
    policy: Policy,
    params: Params,
    layout: Layout,
    state: State | None = None,
    *,
    key: Key[Array, ""] | None = None,
    samples: int = SAMPLES,
    what_if: bool = False,
) -> Advice:
    """Advise on the next visit: the one with which lives, less the price of the first failure, are the longest.

    Compiled once for a policy and a number of devices.

    Args:
        policy: who goes on after the next visit: a trained one (:func:`um.load_policy`) or a heuristic.
        params: scenario parameters.
        layout: the devices.
        state: where the network stands; by default at its beginning.
        key: of the futures' task volumes; by default the same in every call.
        samples: futures.
        what_if: whether to try every repair and removal too.
    """
    state = initial_state(params, layout) if state is None else state
    futures = jax.random.split(jax.random.key(0) if key is None else key, samples)
    own, played = _try_all(policy, params, layout, state, futures)
    lives = np.asarray(played.length, float)
    worth = lives - np.asarray(played.first_failure) @ np.asarray(layout.failure_price(state.elapsed))
    of_policy = int(own)
    best = int(np.argmax(worth.mean(axis=1) + 1e-3 * (np.arange(len(worth)) == of_policy)))
    end = jax.tree.map(lambda leaf: np.asarray(leaf[best]), played)
    return Advice(
        chosen=best,
        of_policy=of_policy,
        candidates=_ranked(lives, worth, best),
        lifetimes=lives[best].astype(int),
        first_failure=end.first_failure.mean(axis=0),
        failure_slot=_mean_slot(end),
        causes={cause: float(np.mean(end.cause == cause)) for cause in Cause if np.any(end.cause == cause)},
        what_if=_try_changes(policy, params, layout, state, futures) if what_if else (),
    )


@partial(jax.jit, static_argnames="policy")
def _try_all(
    policy: Policy, params: Params, layout: Layout, state: State, futures: Key[Array, " S"]
) -> tuple[Array, Episode]:
    """The policy's own choice, and episodes ``[n, S]``: every device visited next in every future."""

    def one(action: Array, future: Array) -> Episode:
        def first_this(params: Params, layout: Layout, later: State, key: Any = None) -> Array:
            return jnp.where(later.slot == state.slot, action, policy(params, layout, later, key))

        return play_on(first_this, params, layout, state, future)

    actions = jnp.arange(layout.capacity.shape[0])
    return policy(params, layout, state, futures[0]), jax.vmap(jax.vmap(one, (None, 0)), (0, None))(actions, futures)


def _try_changes(
    policy: Policy, params: Params, layout: Layout, state: State, futures: Key[Array, " S"]
) -> tuple[WhatIf, ...]:
    """Every change of one device, with the policy deciding from the present state on."""
    layouts = jax.tree.map(lambda *leaves: jnp.stack(leaves), layout, *every_change(layout))
    lives = np.asarray(_play_changed(policy, params, layouts, state, futures))
    return rank_changes(layout, lives[1:], lives[0])


@partial(jax.jit, static_argnames="policy")
def _play_changed(policy: Policy, params: Params, layouts: Layout, state: State, futures: Key[Array, " S"]) -> Array:
    one = lambda layout, future: play_on(policy, params, layout, state, future).length  # noqa: E731
    return jax.vmap(jax.vmap(one, (None, 0)), (0, None))(layouts, futures)


def _ranked(lives: np.ndarray, worth: np.ndarray, best: int) -> tuple[Candidate, ...]:
    """The candidates of ``lives, worth [n, S]``, ``best`` first, then by what they are worth on average."""
    behind = worth[best] - worth
    spread = 1.96 * behind.std(axis=1, ddof=min(1, lives.shape[1] - 1)) / np.sqrt(lives.shape[1])
    order = sorted(range(len(lives)), key=lambda device: (device != best, -worth[device].mean(), device))
    return tuple(
        Candidate(
            device=device,
            lifetime=float(lives[device].mean()),
            behind=float(behind[device].mean()),
            behind_low=float(behind[device].mean() - spread[device]),
            behind_high=float(behind[device].mean() + spread[device]),
        )
        for device in order
    )


def _mean_slot(end: Episode) -> np.ndarray:
    """``[n]`` mean slot of failing first."""
    share, slot = np.asarray(end.first_failure), np.asarray(end.length)
    total = share.sum(axis=0)
    return np.where(total > 0, (share * slot[:, None]).sum(axis=0) / np.maximum(total, 1e-9), np.nan)

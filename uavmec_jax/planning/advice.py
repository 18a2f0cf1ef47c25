"""Advice for the next slot: which device to visit, what to expect then, and what a repair would bring.

The method is one step of the rollout planner (:mod:`uavmec_jax.planning.rollout_planner`), with so many futures that the
distribution of their outcomes is worth reporting.
"""

from dataclasses import dataclass
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from uavmec_jax.env.dynamics import State, complete_state, initial_state
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode, Policy, rollout_from
from uavmec_jax.planning.changes import WhatIf, every_change, rank_changes
from uavmec_jax.planning.forecast import SAMPLES, Forecast
from uavmec_jax.planning.rollout_planner import prefer, try_candidates


@dataclass(frozen=True)
class Candidate:
    """One device as the next visit.

    Attributes:
        device: index from 0.
        lifetime: slots, mean over the futures if the device is visited next and the policy decides from then on.
        behind: slots by which the best candidate's value exceeds this one's on the same futures. The value of a future is
            its lifetime minus the price of its first failure, if the layout's traffic has prices.
        behind_low, behind_high: 95 % confidence interval of that difference over the futures.
    """

    device: int
    lifetime: float
    behind: float
    behind_low: float
    behind_high: float


@dataclass(frozen=True)
class Advice:
    """What to do in one state, and what to expect.

    Attributes:
        candidates: every device, the best first.
        policy_choice: index of the device that the policy itself would visit.
        forecast: the forecast if the best candidate is visited next.
        what_if: every repair and removal of one device, the largest gain first; empty if not asked for.
    """

    candidates: tuple[Candidate, ...]
    policy_choice: int
    forecast: Forecast
    what_if: tuple[WhatIf, ...] = ()

    @property
    def device(self) -> int:
        """Index of the device to visit next."""
        return self.candidates[0].device


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
    """Recommend the next visit: the one with the highest mean lifetime minus the price of the first failure.

    The simulation is compiled once per policy, number of devices and number of futures.

    Args:
        policy: decides after the next visit: a trained policy (:func:`um.load_policy`) or a heuristic.
        params: scenario parameters.
        layout: the devices.
        state: the present state; by default the initial one.
        key: of the futures' task volumes; by default the same in every call.
        samples: number of futures.
        what_if: whether to try every repair and removal too.
    """
    state = initial_state(params, layout) if state is None else state
    chex.assert_equal_shape([state.battery, state.age, layout.capacity])
    state = complete_state(layout, state)
    futures = jax.random.split(jax.random.key(0) if key is None else key, samples)
    choice, episodes = _try_candidates(policy, params, layout, state, futures)
    lifetimes = np.asarray(episodes.length, float)
    price = np.asarray(layout.failure_price(state.elapsed))
    value = lifetimes - np.asarray(episodes.first_failure) @ price
    best = int(np.argmax(prefer(int(choice), value.mean(axis=1))))
    return Advice(
        candidates=_rank(lifetimes, value, best),
        policy_choice=int(choice),
        forecast=Forecast.of(jax.tree.map(lambda leaf: leaf[best], episodes)),
        what_if=_try_changes(policy, params, layout, state, futures) if what_if else (),
    )


@partial(jax.jit, static_argnames="policy")
def _try_candidates(
    policy: Policy, params: Params, layout: Layout, state: State, futures: Key[Array, " S"]
) -> tuple[Int[Array, ""], Episode]:
    """Return the policy's own choice, and the episodes of every candidate, leaves ``[n, S, ...]``."""
    return policy(params, layout, state, futures[0]), try_candidates(policy, params, layout, state, futures)


def _try_changes(
    policy: Policy, params: Params, layout: Layout, state: State, futures: Key[Array, " S"]
) -> tuple[WhatIf, ...]:
    """Return the effect of every change of one device if the policy decides from the present state on."""
    layouts = jax.tree.map(lambda *leaves: jnp.stack(leaves), layout, *every_change(layout))
    lifetimes = np.asarray(_lifetimes(policy, params, layouts, state, futures))
    return rank_changes(layout, lifetimes[1:], lifetimes[0])


@partial(jax.jit, static_argnames="policy")
def _lifetimes(
    policy: Policy, params: Params, layouts: Layout, state: State, futures: Key[Array, " S"]
) -> Int[Array, "L S"]:
    """Return the lifetime in every future for each of ``L`` layouts."""
    lifetime = lambda layout, future: rollout_from(policy, params, layout, state, future).length  # noqa: E731
    return jax.vmap(jax.vmap(lifetime, (None, 0)), (0, None))(layouts, futures)


def _rank(lifetimes: Float[np.ndarray, "n S"], value: Float[np.ndarray, "n S"], best: int) -> tuple[Candidate, ...]:
    """Return the candidates, ``best`` first, then in descending order of their mean value."""
    behind = value[best] - value
    futures = value.shape[1]
    half_width = 1.96 * behind.std(axis=1, ddof=min(1, futures - 1)) / np.sqrt(futures)
    order = sorted(range(len(value)), key=lambda device: (device != best, -value[device].mean(), device))
    return tuple(
        Candidate(
            device=device,
            lifetime=float(lifetimes[device].mean()),
            behind=float(behind[device].mean()),
            behind_low=float(behind[device].mean() - half_width[device]),
            behind_high=float(behind[device].mean() + half_width[device]),
        )
        for device in order
    )

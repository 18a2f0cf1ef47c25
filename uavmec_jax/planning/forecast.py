"""Forecasts: how long a network lives under a policy, which device fails first and when, and what ends it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Key

from uavmec_jax.env.dynamics import Cause, State, initial_state
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode, Policy, rollout_from

SAMPLES = 256
"""Futures that a forecast averages by default."""


@dataclass(frozen=True)
class Forecast:
    """Statistics of ``S`` episodes of one scenario, played to their end with different task volumes.

    Attributes:
        lifetimes: ``[S]`` int slots, counted from the first slot on: those already survived are included.
        first_failure: ``[n]`` probability that each device is the first to fail; the rest is that no device fails.
        failure_slot: ``[n]`` slot in which each device fails, mean over the episodes in which it fails first; NaN if
            it never does.
        causes: share of the episodes that end by each :class:`Cause`; causes that never occur are left out.
    """

    lifetimes: np.ndarray
    first_failure: np.ndarray
    failure_slot: np.ndarray
    causes: Mapping[Cause, float]

    @classmethod
    def of(cls, episodes: Episode) -> "Forecast":
        """Summarise episodes, leaves ``[S, ...]``."""
        lifetimes, cause, share = (
            np.asarray(leaf) for leaf in (episodes.length, episodes.cause, episodes.first_failure)
        )
        total = share.sum(axis=0)
        slot = (share * lifetimes[:, None]).sum(axis=0) / np.maximum(total, 1e-9)
        return cls(
            lifetimes=lifetimes.astype(int),
            first_failure=share.mean(axis=0),
            failure_slot=np.where(total > 0, slot, np.nan),
            causes={one: float(np.mean(cause == one)) for one in Cause if np.any(cause == one)},
        )

    @property
    def interval(self) -> tuple[float, float]:
        """Slots between which 95 % of the episodes end."""
        low, high = np.percentile(self.lifetimes, [2.5, 97.5])
        return float(low), float(high)

    @property
    def no_failure(self) -> float:
        """Probability that no device fails before the UAV's battery or the time limit ends the episode."""
        return max(1.0 - float(self.first_failure.sum()), 0.0)


def make_forecast(
    policy: Policy,
    params: Params,
    layout: Layout,
    state: State | None = None,
    *,
    key: Key[Array, ""] | None = None,
    samples: int = SAMPLES,
) -> Forecast:
    """Forecast how a network fares from a state on if a policy decides.

    Args:
        policy: decides in every slot.
        params: scenario parameters.
        layout: the devices.
        state: the present state; by default the initial one.
        key: of the futures' task volumes; by default the same in every call.
        samples: number of futures.
    """
    state = initial_state(params, layout) if state is None else state
    futures = jax.random.split(jax.random.key(0) if key is None else key, samples)
    return Forecast.of(_play(policy, params, layout, state, futures))


@partial(jax.jit, static_argnames="policy")
def _play(policy: Policy, params: Params, layout: Layout, state: State, futures: Key[Array, " S"]) -> Episode:
    return jax.vmap(lambda future: rollout_from(policy, params, layout, state, future))(futures)

"""Forecasts: how long a network lives under a policy, which device fails first and when, and what ends the episode."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Float, Int, Key, Num

from uavmec_jax.env.checks import check_range
from uavmec_jax.env.dynamics import Cause, State, complete_state, initial_state
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode, Policy, rollout_from
from uavmec_jax.env.scenario_checks import check_scenario
from uavmec_jax.env.state_checks import check_state

SAMPLES = 256
"""Futures simulated for a forecast by default."""


MAX_SAMPLES = 1_000_000
"""Most futures."""


@dataclass(frozen=True)
class Forecast:
    """Statistics of ``S`` episodes of one scenario, simulated to their end with different task volumes.

    Attributes:
        lifetimes: ``[S]`` slots, counted from the first slot of the scenario: those already survived are included.
        first_failure: ``[n]`` probability that each device is the first to fail; they sum to 1 minus :attr:`no_failure`.
        failure_slot: ``[n]`` slot in which each device fails, mean over the episodes in which it is the first; NaN if
            it never is, and with ``end = "horizon"``, where episodes go on.
        causes: share of the episodes that each :class:`Cause` ends; causes that do not occur are left out.
        service_s: ``[S]`` with ``end = "horizon"``, seconds in service from the present state on, see :class:`Episode`;
            else ``None``.
    """

    lifetimes: Int[np.ndarray, " S"]
    first_failure: Float[np.ndarray, " n"]
    failure_slot: Float[np.ndarray, " n"]
    causes: Mapping[Cause, float]
    service_s: Float[np.ndarray, " S"] | None = None

    @classmethod
    def of(cls, episodes: Episode) -> "Forecast":
        """Summarise episodes, leaves ``[S, ...]``."""
        lifetimes, causes, share = (
            np.asarray(leaf) for leaf in (episodes.length, episodes.cause, episodes.first_failure)
        )
        total = share.sum(axis=0) * (episodes.service_s is None)
        slot = (share * lifetimes[:, None]).sum(axis=0) / np.maximum(total, 1e-9)
        return cls(
            lifetimes=lifetimes.astype(int),
            first_failure=share.mean(axis=0),
            failure_slot=np.where(total > 0, slot, np.nan),
            causes={cause: float(np.mean(causes == cause)) for cause in Cause if np.any(causes == cause)},
            service_s=None if episodes.service_s is None else np.asarray(episodes.service_s),
        )

    @property
    def interval(self) -> tuple[float, float]:
        """Slots between which 95 % of the episodes end."""
        return _middle(self.lifetimes)

    @property
    def service_interval(self) -> tuple[float, float] | None:
        """Seconds in service between which 95 % of the episodes are; ``None`` without a horizon."""
        return None if self.service_s is None else _middle(self.service_s)

    @property
    def no_failure(self) -> float:
        """Probability that no device fails before the UAV's battery or the time limit ends the episode."""
        return max(1.0 - float(self.first_failure.sum()), 0.0)


def _middle(values: Num[np.ndarray, " S"]) -> tuple[float, float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)


def make_forecast(
    policy: Policy,
    params: Params,
    layout: Layout,
    state: State | None = None,
    *,
    key: Key[Array, ""] | None = None,
    samples: int = SAMPLES,
) -> Forecast:
    """Forecast the rest of an episode under a policy.

    Args:
        policy: decides in every slot.
        params: scenario parameters.
        layout: the devices.
        state: the present state; by default the initial one.
        key: of the futures' task volumes; by default the same in every call.
        samples: number of futures.

    Raises:
        ArgumentError: a parameter, a value of the layout or the state, or the number of futures is out of range; one line.
    """
    check_range("samples", samples, ge=1, le=MAX_SAMPLES, whole=True)
    check_scenario(params, layout)
    state = initial_state(params, layout) if state is None else complete_state(layout, state)
    check_state(layout, state)
    futures = jax.random.split(jax.random.key(0) if key is None else key, samples)
    return Forecast.of(_simulate(policy, params, layout, state, futures))


@partial(jax.jit, static_argnames="policy")
def _simulate(policy: Policy, params: Params, layout: Layout, state: State, futures: Key[Array, " S"]) -> Episode:
    """Simulate the episode of each future; leaves ``[S, ...]``."""
    return jax.vmap(lambda future: rollout_from(policy, params, layout, state, future))(futures)

"""Advice for the next slot: where each UAV goes, what to expect then, and what a repair would bring.

The method is one step of the rollout planner (:mod:`uavmec_jax.planning.rollout_planner`), with so many futures that the
distribution of their outcomes is worth reporting.
"""

import math
from dataclasses import dataclass, replace
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Key, PRNGKeyArray

from uavmec_jax.env.checks import check_range
from uavmec_jax.env.dynamics import State, complete_state, initial_state
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Episode, Policy, rollout_from, trace_from
from uavmec_jax.env.scenario_checks import check_scenario
from uavmec_jax.env.state_checks import check_state
from uavmec_jax.planning.changes import WhatIf, layouts_to_try, rank_changes, states_to_try
from uavmec_jax.planning.forecast import MAX_SAMPLES, SAMPLES, Forecast
from uavmec_jax.planning.rollout_planner import candidates_of, prefer, try_candidates, values_of

_RETURN_SAMPLES = 32
"""Futures in which it is looked up when the UAVs return to a depot."""

RETURN_SLOTS = 128
"""Slots within which it is looked up; a UAV of the paper has to return after 33."""


@dataclass(frozen=True)
class Candidate:
    """One place as the next target.

    Attributes:
        place: index of the place from 0: a device, or after the devices a depot.
        lifetime: slots, mean over the futures if the UAV flies there next and the policy decides from then on.
        behind: slots by which the best candidate's value exceeds this one's on the same futures. The value of a future is
            its lifetime minus the price of its first failure, if the layout's traffic has prices; for fleets, the last slot
            counts up to the first failure in it. With ``end = "horizon"`` it is the share of the time left to the horizon in
            which the devices are in service.
        behind_low, behind_high: 95 % confidence interval of that difference over the futures.
        service: with ``end = "horizon"``, that share, mean over the futures; else ``None``.
    """

    place: int
    lifetime: float
    behind: float
    behind_low: float
    behind_high: float
    service: float | None = None


@dataclass(frozen=True)
class UavAdvice:
    """What one UAV should do next, the UAVs before it having decided already and those after it doing what the policy says.

    Attributes:
        candidates: every place, the best first.
        policy_choice: index of the place that the policy itself would send it to.
        returns_in: slots until it flies to a depot, this one counting 0, median over futures in which it follows the policy
            from the next slot on; NaN if in half or more of them it never does.
        returns_in_s: s until the slot in which it does, likewise.
    """

    candidates: tuple[Candidate, ...]
    policy_choice: int
    returns_in: float = math.nan
    returns_in_s: float = math.nan

    @property
    def place(self) -> int:
        """Index of the place to fly to next."""
        return self.candidates[0].place


@dataclass(frozen=True)
class Advice:
    """What to do in one state, and what to expect.

    Attributes:
        uavs: the advice for each UAV.
        forecast: the forecast if every UAV follows it.
        what_if: every repair and removal of one device, the largest gain first; empty if not asked for.
    """

    uavs: tuple[UavAdvice, ...]
    forecast: Forecast
    what_if: tuple[WhatIf, ...] = ()

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Candidates of the only UAV, or of the first one."""
        return self.uavs[0].candidates

    @property
    def policy_choice(self) -> int:
        """Index of the place that the policy itself would send the only UAV, or the first one, to."""
        return self.uavs[0].policy_choice

    @property
    def place(self) -> int:
        """Index of the place to fly to next for the only UAV, or the first one."""
        return self.uavs[0].place


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
    """Recommend the next targets: those with the highest mean lifetime minus the price of the first failure; with a horizon,
    those with which the devices are in service longest.

    UAVs decide one after the other, as in :func:`rollout_planner`. The simulation is compiled once per policy, numbers of
    devices, UAVs and depots, and number of futures.

    Args:
        policy: decides after the next slot: a trained policy (:func:`um.load_policy`) or a heuristic.
        params: scenario parameters.
        layout: the devices, the UAVs and the depots.
        state: the present state; by default the initial one.
        key: of the futures' task volumes; by default the same in every call.
        samples: number of futures.
        what_if: whether to try every repair and removal too.

    Raises:
        ArgumentError: a parameter, a value of the layout or the state, or the number of futures is out of range; one line.
    """
    check_range("samples", samples, ge=1, le=MAX_SAMPLES, whole=True)
    check_scenario(params, layout)
    state = initial_state(params, layout) if state is None else state
    chex.assert_equal_shape([state.battery, state.age, layout.capacity])
    state = complete_state(layout, state)
    check_state(layout, state)
    futures = jax.random.split(jax.random.key(0) if key is None else key, samples)
    action = None if layout.n_uavs == 1 else _choose(policy, params, layout, state, futures[0])
    uavs = []
    for uav in range(layout.n_uavs):
        choice, candidates, episodes = _try_candidates(policy, params, layout, state, futures, action, np.int32(uav))
        lifetimes, value = np.asarray(episodes.length, float), _values(params, layout, state, episodes)
        unit = float(params.slot_cap_s) / _seconds_left(params, state) if params.end == "horizon" else 1.0
        mine = int(np.atleast_1d(choice)[uav])
        best = int(np.argmax(prefer(mine, value.mean(axis=1))))
        shares = params.end == "horizon"
        uavs.append(
            UavAdvice(candidates=_rank(lifetimes, unit * value, best, values_are_shares=shares), policy_choice=mine)
        )
        action = candidates[best]
    if layout.n_depots:
        slots, seconds = _returns_in(policy, params, layout, state, futures[:_RETURN_SAMPLES], action)
        uavs = [
            replace(uav, returns_in=_median(slots[:, v]), returns_in_s=_median(seconds[:, v]))
            for v, uav in enumerate(uavs)
        ]
    return Advice(
        uavs=tuple(uavs),
        forecast=Forecast.of(jax.tree.map(lambda leaf: leaf[best], episodes)),
        what_if=_try_changes(policy, params, layout, state, futures) if what_if else (),
    )


def _median(values: Float[Array, " S"]) -> float:
    """Return the median over the futures; NaN if it is not finite."""
    median = float(np.median(np.asarray(values)))
    return median if math.isfinite(median) else math.nan


def _seconds_left(params: Params, state: State) -> float:
    """Return the time to the horizon, at least 1 s."""
    return max(float(params.horizon_s) - float(state.elapsed), 1.0)


def _values(params: Params, layout: Layout, state: State, episodes: Episode) -> Float[np.ndarray, "C S"]:
    """Return the value of each future of each candidate in slots; see :class:`Candidate`."""
    values = np.asarray(values_of(params, layout, episodes), float)
    if params.end == "horizon":
        return values
    return values - np.asarray(episodes.first_failure) @ np.asarray(layout.failure_price(state.elapsed))


@partial(jax.jit, static_argnames="policy")
def _choose(policy: Policy, params: Params, layout: Layout, state: State, key: PRNGKeyArray) -> Int[Array, " K"]:
    return policy(params, layout, state, key)


@partial(jax.jit, static_argnames="policy")
def _try_candidates(
    policy: Policy,
    params: Params,
    layout: Layout,
    state: State,
    futures: Key[Array, " S"],
    action: Int[Array, "*K"] | None,
    uav: Int[ArrayLike, ""],
) -> tuple[Int[Array, "*K"], Int[Array, "C *K"], Episode]:
    """Return the policy's own choice, the candidate actions of one UAV, and their episodes, leaves ``[C, S, ...]``.

    The other UAVs keep to ``action``, by default to the policy's choice.
    """
    choice = policy(params, layout, state, futures[0])
    candidates = candidates_of(layout, choice if action is None else action, jnp.asarray(uav))
    return choice, candidates, try_candidates(policy, params, layout, state, futures, candidates)


@partial(jax.jit, static_argnames="policy")
def _returns_in(
    policy: Policy, params: Params, layout: Layout, state: State, futures: Key[Array, " S"], action: Int[Array, "*K"]
) -> tuple[Float[Array, "S K"], Float[Array, "S K"]]:
    """Return the slots and the seconds until each UAV first flies to a depot in each future, inf if it does not."""

    def until(future: PRNGKeyArray) -> tuple[Float[Array, " K"], Float[Array, " K"]]:
        def act(params: Params, layout: Layout, later: State, key: PRNGKeyArray | None = None) -> Array:
            return jnp.where(later.slot == state.slot, action, policy(params, layout, later, key))

        slots = trace_from(act, params, layout, state, future, RETURN_SLOTS)
        flies = slots.played[:, None] & ~jnp.concatenate([state.grounded[None], slots.state.grounded[:-1]])
        to_depot = flies & (slots.action.reshape(RETURN_SLOTS, -1) >= layout.n_devices)
        first, ever = jnp.argmax(to_depot, axis=0), jnp.any(to_depot, axis=0)
        begins = jnp.append(jnp.asarray(state.elapsed), slots.state.elapsed)
        seconds = begins[first] - state.elapsed
        return jnp.where(ever, first.astype(jnp.float32), jnp.inf), jnp.where(ever, seconds, jnp.inf)

    return jax.vmap(until)(futures)


def _try_changes(
    policy: Policy, params: Params, layout: Layout, state: State, futures: Key[Array, " S"]
) -> tuple[WhatIf, ...]:
    """Return the effect of every change of one device if the policy decides from the present state on."""
    layouts, states = layouts_to_try(params, layout), states_to_try(params, layout, state)
    episodes = _play_layouts(policy, params, layouts, states, futures)
    return rank_changes(params, layout, episodes, _seconds_left(params, state))


@partial(jax.jit, static_argnames="policy")
def _play_layouts(policy: Policy, params: Params, layouts: Layout, states: State, futures: Key[Array, " S"]) -> Episode:
    """Return the episode of every future for each of ``L`` layouts from its own state, leaves ``[L, S, ...]``."""
    play = lambda layout, state, future: rollout_from(policy, params, layout, state, future)  # noqa: E731
    return jax.vmap(jax.vmap(play, (None, None, 0)), (0, 0, None))(layouts, states, futures)


def _rank(
    lifetimes: Float[np.ndarray, "C S"], value: Float[np.ndarray, "C S"], best: int, *, values_are_shares: bool
) -> tuple[Candidate, ...]:
    """Return the candidates, ``best`` first, then in descending order of their mean value."""
    behind = value[best] - value
    futures = value.shape[1]
    half_width = 1.96 * behind.std(axis=1, ddof=min(1, futures - 1)) / np.sqrt(futures)
    order = sorted(range(len(value)), key=lambda place: (place != best, -value[place].mean(), place))
    return tuple(
        Candidate(
            place=place,
            lifetime=float(lifetimes[place].mean()),
            behind=float(behind[place].mean()),
            behind_low=float(behind[place].mean() - half_width[place]),
            behind_high=float(behind[place].mean() + half_width[place]),
            service=float(value[place].mean()) if values_are_shares else None,
        )
        for place in order
    )

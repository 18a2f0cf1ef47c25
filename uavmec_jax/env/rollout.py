"""Episodes: every policy, learned or not, is evaluated by these loops."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Key, PRNGKeyArray

from uavmec_jax.env.checks import check_range
from uavmec_jax.env.dynamics import Cause, Outcome, State, complete_state, initial_state, service, transition
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import MAX_DEVICES, Params, check_params
from uavmec_jax.env.rewards import check_reward
from uavmec_jax.env.scenario import Scenario, advance, draw_volumes
from uavmec_jax.env.scenario_checks import check_scenario
from uavmec_jax.env.state_checks import check_state
from uavmec_jax.env.types import Scalar
from uavmec_jax.errors import ArgumentError

Policy = Callable[..., Array]
"""``policy(params, layout, state, key=None) -> action``, an int32 place in ``[0, n + D)``, one per UAV (``[K]``) if there
are several; pure, works under ``jit`` and ``vmap``."""

_POLICY_STREAM = 2**32 - 1
"""``fold_in`` number of the policy's randomness; the volumes of slot ``t`` have the number ``t``."""


@struct.dataclass
class Episode:
    """The result of one episode.

    Attributes:
        length: the lifetime in slots (paper: episode length), int32.
        cause: why it ended, a :class:`Cause` as int32; ``NONE`` if the time limit ended it.
        failed: devices that failed in the last slot.
        first_failure: each device's share in the first failure; sums to 1 unless no device failed.
        lasted: share of the last slot that was over when the first battery ran out, 1 if none did.
        service_s: with ``end = "horizon"``, seconds until the horizon in which the devices were in service
            (:func:`dynamics.service`), mean over the devices weighted by their priorities; else ``None``.
    """

    length: Int[Array, "*batch"]
    cause: Int[Array, "*batch"]
    failed: Bool[Array, "*batch n"]
    first_failure: Float[Array, "*batch n"]
    lasted: Scalar = 1.0
    service_s: Float[Array, "*batch"] | None = None


def slot_volumes(params: Params, n_devices: int, key: PRNGKeyArray, slot: Int[ArrayLike, ""]) -> Float[Array, " n"]:
    """Draw the task volumes ``[n]`` of one slot, in bytes; ``key`` stands for the volumes of a whole episode."""
    return draw_volumes(params, jax.random.uniform(jax.random.fold_in(key, slot), (n_devices,)))


def volume_table(params: Params, n_devices: int, key: PRNGKeyArray, slots: int) -> Float[Array, "slots n"]:
    """Draw the task volumes of the first slots, in bytes; :func:`rollout` with the same key has the same volumes.

    Raises:
        ArgumentError: there are no devices or no slots, or a parameter is out of range; one line.
    """
    check_params(params)
    check_range("n_devices", n_devices, ge=1, le=MAX_DEVICES, whole=True)
    check_range("slots", slots, ge=1, whole=True)
    return jax.vmap(lambda slot: slot_volumes(params, n_devices, key, slot))(jnp.arange(slots))


def rollout(policy: Policy, params: Params, layout: Layout, key: PRNGKeyArray) -> Episode:
    """Play one episode.

    Args:
        policy: chooses each UAV's place in each slot.
        params: simulation parameters.
        layout: the devices.
        key: draws the task volumes: two policies with the same key have the same volumes, slot by slot. The policy's
            own randomness comes from another stream of the key.

    Raises:
        ArgumentError: a parameter or a value of the layout is out of range; one line. Traced values are checked only inside
            :func:`um.debug_checks`. Nor are the policy's actions known here: out of range is clamped.
    """
    return rollout_from(policy, params, layout, initial_state(params, layout), key)


def rollout_from(policy: Policy, params: Params, layout: Layout, state: State, key: PRNGKeyArray) -> Episode:
    """Play an episode as :func:`rollout` does, but from any state in which the episode has not ended.

    Raises:
        ArgumentError: as in :func:`rollout`, and for the state.
    """
    check_scenario(params, layout)
    check_state(layout, state)
    return _play(policy, params, layout, state, key, slots=0)[1]


def rollout_with_actions(
    policy: Policy, params: Params, layout: Layout, key: PRNGKeyArray, slots: int
) -> tuple[Int[Array, "slots *K"], Episode]:
    """Play one episode as :func:`rollout` does and return the actions in its first slots, -1 after its end."""
    return _play(policy, params, layout, initial_state(params, layout), key, slots)


class _Progress(NamedTuple):
    """An episode so far: the state, the outcome of the last slot, the first actions, and with a horizon, its tally."""

    state: State
    outcome: Outcome
    actions: Int[Array, "slots *K"]
    first_failure: Float[Array, " n"] | None
    service_s: Float[Array, ""] | None


def _play(
    policy: Policy, params: Params, layout: Layout, state: State, key: PRNGKeyArray, slots: int
) -> tuple[Int[Array, "slots *K"], Episode]:
    """Play an episode from ``state`` to its end; return the first ``slots`` actions and the result."""
    play_slot = _make_play_slot(policy, params, layout, key)

    def next_slot(progress: _Progress) -> _Progress:
        state, first_failure, service_s = progress.state, progress.first_failure, progress.service_s
        action, after, outcome = play_slot(state)
        actions = progress.actions.at[state.slot].set(action, mode="drop") if slots else progress.actions
        if first_failure is not None and service_s is not None:
            first_failure = jnp.where(jnp.any(first_failure > 0), first_failure, outcome.first_failure)
            until_horizon = jnp.clip(params.horizon_s - state.elapsed, 0.0, outcome.duration)
            service_s = service_s + until_horizon * service(params, layout, after)
        return _Progress(after, outcome, actions, first_failure, service_s)

    goes_on = params.end == "horizon"
    last = jax.lax.while_loop(
        lambda progress: _is_running(params, progress.state, progress.outcome),
        next_slot,
        _Progress(
            state=complete_state(layout, state),
            outcome=_initial_outcome(layout.n_devices),
            actions=jnp.full((slots, *layout.action_shape), -1, jnp.int32),
            first_failure=jnp.zeros(layout.n_devices) if goes_on else None,
            service_s=jnp.zeros(()) if goes_on else None,
        ),
    )
    episode = Episode(
        length=last.state.slot,
        cause=last.outcome.cause,
        failed=last.outcome.failed,
        first_failure=last.outcome.first_failure if last.first_failure is None else last.first_failure,
        lasted=last.outcome.lasted,
        service_s=last.service_s,
    )
    return last.actions, episode


def _is_running(params: Params, state: State, outcome: Outcome) -> Bool[Array, ""]:
    """Return whether the episode continues after a slot: nothing has ended it, and the time limit is not reached."""
    return (outcome.cause == Cause.NONE) & (state.slot < params.max_slots)


def _make_play_slot(
    policy: Policy, params: Params, layout: Layout, key: PRNGKeyArray
) -> Callable[[State], tuple[Array, State, Outcome]]:
    """Return the function that plays one slot of an episode: ``state -> (action, next state, outcome)``."""
    act, volumes = _make_act_and_volumes(policy, params, layout, key)

    def play_slot(state: State) -> tuple[Array, State, Outcome]:
        action = act(state)
        return action, *transition(params, layout, state, action, volumes(state))

    return play_slot


def _make_act_and_volumes(
    policy: Policy, params: Params, layout: Layout, key: PRNGKeyArray
) -> tuple[Callable[[State], Array], Callable[[State], Array]]:
    """Return the functions of the state that give an episode's action and task volumes ``[n]``, both drawn from ``key``."""
    _check_policy(policy)
    policy_key = jax.random.fold_in(key, _POLICY_STREAM)

    def act(state: State) -> Array:
        return policy(params, layout, state, jax.random.fold_in(policy_key, state.slot))

    def volumes(state: State) -> Float[Array, " n"]:
        return slot_volumes(params, layout.n_devices, key, state.slot)

    return act, volumes


def _check_policy(policy: Policy) -> None:
    """Check that a policy is a function, and not the name of one.

    Raises:
        ArgumentError: one line.
    """
    if not callable(policy):
        raise ArgumentError(
            f"policy is {policy!r}; it should be a function such as um.planning.HEURISTICS['oldest-first'] or "
            "um.load_policy('generalist')"
        )


def _initial_outcome(n: int) -> Outcome:
    """Return the outcome before the first slot."""
    return Outcome(
        cause=jnp.int32(Cause.NONE),
        failed=jnp.zeros(n, bool),
        served=jnp.zeros(n, bool),
        duration=jnp.float32(0),
        first_failure=jnp.zeros(n, jnp.float32),
        lasted=jnp.float32(1),
    )


def rollouts(policy: Policy, params: Params, layout: Layout, keys: Key[Array, " D"]) -> Episode:
    """Play one episode per key, that is, per draw of the task volumes; the result's leaves are ``[D, ...]``.

    Raises:
        ArgumentError: as in :func:`rollout`, or there is no key.
    """
    check_range("the number of keys", len(keys), ge=1, whole=True)
    return jax.vmap(lambda key: rollout(policy, params, layout, key))(keys)


def returns(policy: Policy, scenario: Scenario, keys: Key[Array, " D"]) -> Float[Array, " D"]:
    """Return the undiscounted sums of the rewards in the episodes that :func:`rollouts` plays."""
    check_scenario(scenario.params, scenario.layout)
    check_reward(scenario.reward)

    def episode_return(key: PRNGKeyArray) -> Float[Array, ""]:
        act, volumes = _make_act_and_volumes(policy, scenario.params, scenario.layout, key)

        def next_slot(carry: tuple[State, Outcome, Array]) -> tuple[State, Outcome, Array]:
            state, _, total = carry
            after, reward, outcome = advance(scenario, state, act(state), volumes(state))
            return after, outcome, total + reward

        def is_running(carry: tuple[State, Outcome, Array]) -> Bool[Array, ""]:
            return _is_running(scenario.params, *carry[:2])

        outcome = _initial_outcome(scenario.layout.n_devices)
        start = (initial_state(scenario.params, scenario.layout), outcome, jnp.zeros(()))
        return jax.lax.while_loop(is_running, next_slot, start)[2]

    return jax.vmap(episode_return)(keys)


@struct.dataclass
class Trace:
    """An episode slot by slot, ``*batch`` = ``[H]``. Slots after its end repeat the last state and outcome.

    Attributes:
        played: whether the slot belongs to the episode.
        action: place of each UAV, int32, as policies return it.
        state: the state after each slot, leaves ``[H, ...]``.
        outcome: the outcome of each slot, leaves ``[H, ...]``.
    """

    played: Bool[Array, "*batch"]
    action: Int[Array, "*batch_K"]
    state: State
    outcome: Outcome


def trace(policy: Policy, params: Params, layout: Layout, key: PRNGKeyArray, slots: int) -> Trace:
    """Record the first ``slots`` slots of the episode that :func:`rollout` plays with the same key."""
    return trace_from(policy, params, layout, initial_state(params, layout), key, slots)


def trace_from(policy: Policy, params: Params, layout: Layout, state: State, key: PRNGKeyArray, slots: int) -> Trace:
    """Record the next ``slots`` slots of the episode that :func:`rollout_from` plays with the same key.

    Raises:
        ArgumentError: as in :func:`rollout_from`, or there are no slots.
    """
    check_scenario(params, layout)
    check_state(layout, state)
    check_range("slots", slots, ge=1, whole=True)
    play_slot = _make_play_slot(policy, params, layout, key)

    def play_if(carry: tuple[State, Outcome], _: None) -> tuple[tuple[State, Outcome], Trace]:
        played = _is_running(params, *carry)
        action, *new = play_slot(carry[0])
        state, outcome = jax.tree.map(lambda new, old: jnp.where(played, new, old), tuple(new), carry)
        return (state, outcome), Trace(played=played, action=action, state=state, outcome=outcome)

    start = (complete_state(layout, state), _initial_outcome(layout.n_devices))
    return jax.lax.scan(play_if, start, None, length=slots)[1]


def tour_policy(actions: Int[Array, "H *K"]) -> Policy:
    """Return the policy that follows a fixed tour: in each slot it takes ``actions[slot]``.

    Where the tour has come to its end (-1) and the network lives on, the UAVs fly to device 0.
    """
    return lambda params, layout, state, key=None: jnp.maximum(actions[state.slot], 0)

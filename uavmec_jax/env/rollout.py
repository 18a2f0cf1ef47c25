"""Play whole episodes: every policy, learned or not, is judged by this one loop."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray

from uavmec_jax.env.dynamics import Cause, Outcome, State, initial_state, transition
from uavmec_jax.env.generator import ScenarioDistribution, scenario_from_draw
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.scenario import Scenario, advance, draw_volumes

Policy = Callable[..., Array]
"""``policy(params, layout, state, key=None) -> action``: int32 in ``[0, n)``; pure, jit- and vmap-able."""

_POLICY_STREAM = 2**32 - 1
"""``fold_in`` number of the policy's own randomness; the slots' volumes use their own numbers, from 0."""


@struct.dataclass
class Episode:
    """How one episode went.

    Attributes:
        length: int32, the lifetime in slots (paper: episode length).
        cause: int32, a :class:`Cause`; ``NONE`` if the time limit ended it.
        failed: ``[n]`` bool, devices that failed in the last slot.
        first_failure: ``[n]`` f32, share of each device in the first failure; sums to 1 unless no device failed.
    """

    length: Int[Array, "*batch"]
    cause: Int[Array, "*batch"]
    failed: Bool[Array, "*batch n"]
    first_failure: Float[Array, "*batch n"]


def slot_volumes(params: Params, n_devices: int, key: PRNGKeyArray, slot: Any) -> Array:
    """Task volumes ``[n]`` in bytes of slot number ``slot`` in the volume draw that ``key`` stands for."""
    return draw_volumes(params, jax.random.uniform(jax.random.fold_in(key, slot), (n_devices,)))


def volume_table(params: Params, n_devices: int, key: PRNGKeyArray, slots: int) -> Array:
    """Volumes ``[slots, n]`` in bytes of the first slots of a volume draw, as the rollout of ``key`` meets them."""
    return jax.vmap(lambda slot: slot_volumes(params, n_devices, key, slot))(jnp.arange(slots))


def rollout(policy: Policy, params: Params, layout: Layout, key: PRNGKeyArray) -> Episode:
    """Play one episode.

    Args:
        policy: whom to ask for the next device.
        params: scenario parameters.
        layout: the devices.
        key: the volume draw. Two policies given the same key meet the same volumes, slot by slot. The policy's own
            randomness comes from another stream of the key.
    """
    return rollout_from(policy, params, layout, initial_state(params, layout), key)


def rollout_from(policy: Policy, params: Params, layout: Layout, state: State, key: PRNGKeyArray) -> Episode:
    """Play an episode to its end from any state that has not failed; otherwise as :func:`rollout`."""
    return _play(policy, params, layout, state, key, slots=0)[1]


def rollout_with_actions(
    policy: Policy, params: Params, layout: Layout, key: PRNGKeyArray, slots: int
) -> tuple[Int[Array, " slots"], Episode]:
    """As :func:`rollout`, and the devices visited in the first ``slots`` slots; -1 after the end."""
    return _play(policy, params, layout, initial_state(params, layout), key, slots)


def _play(
    policy: Policy, params: Params, layout: Layout, state: State, key: PRNGKeyArray, slots: int
) -> tuple[Array, Episode]:
    play_slot = _slot_player(policy, params, layout, key)

    def going_on(carry: tuple[State, Outcome, Array]) -> Array:
        return _goes_on(params, *carry[:2])

    def next_slot(carry: tuple[State, Outcome, Array]) -> tuple[State, Outcome, Array]:
        state, _, visited = carry
        action, after, outcome = play_slot(state)
        return after, outcome, visited.at[state.slot].set(action, mode="drop") if slots else visited

    start = (state, _nothing(layout.capacity.shape[0]), jnp.full(slots, -1, jnp.int32))
    state, outcome, visited = jax.lax.while_loop(going_on, next_slot, start)
    ended = Episode(length=state.slot, cause=outcome.cause, failed=outcome.failed, first_failure=outcome.first_failure)
    return visited, ended


def _goes_on(params: Params, state: State, outcome: Outcome) -> Array:
    """Whether another slot is played."""
    return (outcome.cause == Cause.NONE) & (state.slot < params.max_slots)


def _slot_player(
    policy: Policy, params: Params, layout: Layout, key: PRNGKeyArray
) -> Callable[[State], tuple[Array, State, Outcome]]:
    """What plays one slot of the episode of ``key``: the policy's action, the state after it, the outcome."""
    act, volumes = _decisions(policy, params, layout, key)

    def play_slot(state: State) -> tuple[Array, State, Outcome]:
        action = act(state)
        return action, *transition(params, layout, state, action, volumes(state))

    return play_slot


def _decisions(
    policy: Policy, params: Params, layout: Layout, key: PRNGKeyArray
) -> tuple[Callable[[State], Array], Callable[[State], Array]]:
    """The policy's action and the task volumes in a state of the episode of ``key``."""
    policy_key = jax.random.fold_in(key, _POLICY_STREAM)
    return (
        lambda state: policy(params, layout, state, jax.random.fold_in(policy_key, state.slot)),
        lambda state: slot_volumes(params, layout.capacity.shape[0], key, state.slot),
    )


def _nothing(n: int) -> Outcome:
    """The outcome before the first slot."""
    return Outcome(
        cause=jnp.int32(Cause.NONE),
        failed=jnp.zeros(n, bool),
        served=jnp.zeros(n, bool),
        duration=jnp.float32(0),
        first_failure=jnp.zeros(n, jnp.float32),
    )


def rollouts(policy: Policy, params: Params, layout: Layout, keys: Key[Array, " D"]) -> Episode:
    """Play one episode per volume draw; ``keys`` is ``[D]`` and every field of the result gains a leading ``D``."""
    return jax.vmap(lambda key: rollout(policy, params, layout, key))(keys)


def returns(policy: Policy, scenario: Scenario, keys: Key[Array, " D"]) -> Float[Array, " D"]:
    """Undiscounted sum of the rewards of the episodes that :func:`rollouts` plays."""

    def one(key: PRNGKeyArray) -> Array:
        act, volumes = _decisions(policy, scenario.params, scenario.layout, key)

        def next_slot(carry: tuple[State, Outcome, Array]) -> tuple[State, Outcome, Array]:
            after, reward, outcome = advance(scenario, carry[0], act(carry[0]), volumes(carry[0]))
            return after, outcome, carry[2] + reward

        def going_on(carry: tuple[State, Outcome, Array]) -> Array:
            return _goes_on(scenario.params, *carry[:2])

        nothing = _nothing(scenario.layout.capacity.shape[0])
        start = (initial_state(scenario.params, scenario.layout), nothing, jnp.zeros(()))
        return jax.lax.while_loop(going_on, next_slot, start)[2]

    return jax.vmap(one)(keys)


@struct.dataclass
class Trace:
    """An episode slot by slot; ``H`` slots, those after the end repeat the last state and have ``played`` False.

    Attributes:
        played: ``[H]`` bool.
        action: ``[H]`` int32, device visited.
        state: leaves ``[H, ...]``, the state after each slot.
        outcome: leaves ``[H, ...]``, what each slot did.
    """

    played: Bool[Array, "*batch H"]
    action: Int[Array, "*batch H"]
    state: State
    outcome: Outcome


def trace(policy: Policy, params: Params, layout: Layout, key: PRNGKeyArray, slots: int) -> Trace:
    """The first ``slots`` slots of the episode that :func:`rollout` plays with the same key."""
    play_slot = _slot_player(policy, params, layout, key)

    def play_if(carry: tuple[State, Outcome], _: None) -> tuple[tuple[State, Outcome], Trace]:
        played = _goes_on(params, *carry)
        action, *new = play_slot(carry[0])
        state, outcome = jax.tree.map(lambda new, old: jnp.where(played, new, old), tuple(new), carry)
        return (state, outcome), Trace(played=played, action=action, state=state, outcome=outcome)

    start = (initial_state(params, layout), _nothing(layout.capacity.shape[0]))
    return jax.lax.scan(play_if, start, None, length=slots)[1]


def tour_policy(actions: Int[Array, " H"]) -> Policy:
    """The policy that makes a tour: ``actions[slot]``."""
    return lambda params, layout, state, key=None: actions[state.slot]


def rollout_draws(policy: Policy, plays: Scenario | ScenarioDistribution, keys: Key[Array, " D"]) -> Episode:
    """One episode per draw, leaves ``[D]``: of task volumes, or, of a distribution, of a scenario each besides."""
    if isinstance(plays, Scenario):
        return rollouts(policy, plays.params, plays.layout, keys)
    return jax.vmap(lambda key: _rollout_draw(policy, plays, key)[1])(keys)


def priced_lifetimes(policy: Policy, plays: ScenarioDistribution, keys: Key[Array, " D"]) -> Float[Array, " D"]:
    """Slots that the episode of each draw lives, less the price of its first failure."""

    def one(key: PRNGKeyArray) -> Array:
        layout, played = _rollout_draw(policy, plays, key)
        return played.length.astype(jnp.float32) - jnp.sum(played.first_failure * layout.failure_price(0.0))

    return jax.vmap(one)(keys)


def _rollout_draw(policy: Policy, plays: ScenarioDistribution, key: PRNGKeyArray) -> tuple[Layout, Episode]:
    """The layout of a draw and the episode in it."""
    scenario = scenario_from_draw(plays, key)
    return scenario.layout, rollout(policy, scenario.params, scenario.layout, key)

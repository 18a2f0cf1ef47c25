"""Load policies by name or from files: heuristics, planners and trained agents."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy
from uavmec_jax.env.state_checks import check_decision
from uavmec_jax.errors import PolicyError
from uavmec_jax.files.archives import MAX_BYTES, MAX_USER_BYTES
from uavmec_jax.files.locations import StoreError, reached, reason_of
from uavmec_jax.files.validation import suggest
from uavmec_jax.planning.fleet_demand import is_alone
from uavmec_jax.planning.fleet_rules import for_fleets
from uavmec_jax.planning.heuristics import FLEET_HEURISTICS
from uavmec_jax.planning.observation import FEATURES
from uavmec_jax.planning.rollout_planner import rollout_planner
from uavmec_jax.scenarios.distribution import out_of_distribution
from uavmec_jax.scenarios.policy_files import (
    WEIGHTS,
    PolicyCollection,
    observes_devices,
    read_policies,
    select_agent,
    write_policies,
)

_SHIPPED = resources.files("uavmec_jax.scenarios") / "library"
"""Folder of the policies that ship with the package."""


@dataclass(frozen=True, eq=False)
class TrainedPolicy:
    """The greedy policy of one trained agent, with its observation function: it is called like every other policy.

    Attributes:
        algorithm: name of the algorithm that trained it.
        trained_on: the agent's value on every axis of its study: seed, powered, connected, ...
        n_devices: number of devices that the network takes; ``None`` if it takes any number.
        collection: contents of the agent's policy file.
    """

    algorithm: str
    trained_on: Mapping[str, Any]
    n_devices: int | None
    collection: PolicyCollection = field(repr=False)
    _policy: Any = field(repr=False)
    _greedy: Any = field(repr=False)
    _value_fn: Any = field(repr=False)

    @classmethod
    def of(cls, collection: PolicyCollection, name: str, index: int, which: str) -> "TrainedPolicy":
        """Make the policy of one agent of a collection.

        Args:
            collection: policies of trained agents.
            name: algorithm of the agent.
            index: position of the agent among those of its algorithm.
            which: ``"best"`` or ``"last"`` weights.

        Raises:
            PolicyError: there are no such weights, or they are not finite.
        """
        if not all(np.isfinite(leaf[index]).all() for leaf in jax.tree.leaves(collection.weights_of(which, name))):
            raise PolicyError(f"the {which} weights of {name} are not finite: training diverged")
        return _compiled(_Agent(select_agent(collection, name, index, which), name, which))

    def __call__(self, params: Params, layout: Layout, state: State, key: Any = None) -> Int[Array, "*batch"]:
        """Return the device to visit, int32; the state may have any number of batch axes in front.

        The policy decides for one UAV. Several decide in turn by it, and return to depots as rules do (:func:`for_fleets`);
        the result is then a place for each of them. Where episodes go on after a failure, it does not see dead devices.

        Raises:
            PolicyError: the layout has another number of devices.
            ArgumentError: a number of the scenario or the state is out of range; one line. Traced ones are not checked.
        """
        check_decision(params, layout, state)
        if self.n_devices not in (None, layout.capacity.shape[-1]):
            raise PolicyError(
                f"the policy was trained for {self.n_devices} devices; the layout has {layout.capacity.shape[-1]}"
            )
        if is_alone(layout) and params.end == "first_failure":
            action: Array = self._policy(params, layout, state)
            return action
        in_turn: Policy = for_fleets(self._decide)
        for _ in range(jnp.ndim(state.slot)):
            in_turn = jax.vmap(in_turn, (None, None, 0))
        return in_turn(params, layout, state)

    def _decide(self, params: Params, layout: Layout, state: State, key: Any = None) -> Int[Array, ""]:
        """Return the device that the only UAV visits."""
        action: Array = self._policy(params, layout, state)
        return action

    def fleet_warnings(self, layout: Layout) -> list[str]:
        """Say in a line how the policy decides for several UAVs or with depots; nothing for one UAV without depots."""
        if is_alone(layout):
            return []
        words = ["the policy was trained for one UAV without depots"]
        if layout.n_uavs > 1:
            words.append("here the UAVs decide one after another")
        if layout.n_depots:
            words.append("a rule sends UAVs to depots")
        return ["; ".join(words)]

    def act(self, observation: Any) -> Int[np.ndarray, "*batch"]:
        """Return the device to visit, int32, for observations ``[..., obs_size]``.

        Args:
            observation: the paper's observation, ``2n`` numbers; for a policy that takes any number of devices, the full
                one: for each device its features and a 1 behind them.

        Raises:
            PolicyError: the observation has another shape, or is not an array of finite numbers.
        """
        try:
            array = np.asarray(observation)
            if array.dtype.kind not in "biuf":
                raise TypeError(f"its dtype is {array.dtype}")
            array = array.astype(np.float32)
        except (TypeError, ValueError) as error:
            raise PolicyError(f"the observation is not an array of numbers: {error}") from None
        size = 2 * self.n_devices if self.n_devices else len(FEATURES) + 1
        last = array.shape[-1] if array.ndim else 0
        if last != size and (self.n_devices or last == 0 or last % size):
            shapes = f"({size},) or (..., {size})" if self.n_devices else f"(..., {size} for each device)"
            raise PolicyError(f"the observation has the shape {array.shape}; it should be {shapes}")
        if not np.isfinite(array).all():
            raise PolicyError("the observation has numbers that are not finite")
        return np.asarray(self._greedy(array))

    def value(self, params: Params, layout: Layout, states: State) -> Float[Array, " B"]:
        """Estimate the return that follows each of a batch of states, with one batch axis.

        Raises:
            PolicyError: the algorithm has no value network.
        """
        if self._value_fn is None:
            raise PolicyError(f"{self.algorithm} has no value network; PPO and A2C have one")
        value: Array = self._value_fn(params, layout, states)
        return value

    def out_of_distribution(self, params: Params, layout: Layout) -> list[str]:
        """Describe each quantity of a scenario that lies outside the policy's training distribution, one line each.

        Return an empty list for a policy that was trained on one scenario only.
        """
        drawn = self.collection.drawn
        return out_of_distribution(drawn["scenarios"], drawn["params"], params, layout) if drawn else []

    def save(self, path: str | Path) -> None:
        """Write the policy to a file of its own (``.npz``), atomically.

        Raises:
            OSError: the file cannot be written.
            PolicyError: the path is a URL, and its object store cannot be reached or written to.
        """
        with reached(path, PolicyError) as file:
            write_policies(file, self.collection)


class _Agent:
    """The collection of one agent; two with the same contents are equal."""

    def __init__(self, collection: PolicyCollection, name: str, which: str) -> None:
        self.collection, self.name, self.which = collection, name, which
        facts = {key: getattr(collection, key) for key in ("settings", "n_devices", "agents", "drawn")}
        digest = hashlib.sha256(json.dumps([name, which, facts], sort_keys=True, default=str).encode())
        for key, leaf in sorted(collection.weights.items()):
            digest.update(f"{key} {leaf.dtype} {leaf.shape}".encode() + leaf.tobytes())
        self._digest = digest.hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Agent) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)


@lru_cache(maxsize=16)
def _compiled(agent: _Agent) -> TrainedPolicy:
    """Return the policy of an agent. One that is loaded again is the same object, whose programs are compiled already."""
    alone, name = agent.collection, agent.name
    weights = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), alone.weights_of(agent.which, name))
    axes = alone.agents[name][0]
    algorithm, hyper = alone.algorithm(name), alone.hyper(name, axes)
    value_fn = None
    if (network_value := algorithm.value_fn) is not None:
        value_fn = jax.jit(lambda *state: network_value(hyper, weights, algorithm.observation_fn(*state)))
    return TrainedPolicy(
        algorithm=name,
        trained_on=MappingProxyType(axes),
        n_devices=None if observes_devices(alone.settings[name]) else alone.n_devices,
        collection=alone,
        _policy=jax.jit(algorithm.policy(hyper, weights)),
        _greedy=jax.jit(partial(algorithm.greedy, hyper, weights)),
        _value_fn=value_fn,
    )


def load_policy(source: str | Path, which: str = "best", **axes: Any) -> Policy:
    """Load a policy by name, from a file, or of one agent of a run.

    Args:
        source: ``"generalist"``, a name in :data:`FLEET_HEURISTICS`, ``"rollout"``, a policy file, or the folder of a run;
            file and folder may be URLs, such as ``s3://bucket/run``.
        which: ``"best"`` or ``"last"`` weights of a run's agent; a policy file has only one of the two.
        axes: values that select one agent of a run, e.g. ``powered=8, connected=8, seed=3, algorithm="ppo"``; axes on
            which all agents have the same value may be left out.

    Returns:
        ``policy(params, layout, state, key=None) -> action``; a :class:`TrainedPolicy` if it was trained. Loaded again, it is
        the same object as before, and nothing is compiled again; the last 16 are kept.

    Raises:
        PolicyError: there is no such policy; its file is damaged, altered or from another version; its weights are not
            finite; no agent, or more than one, has the given values; or an object store cannot be reached.
    """
    if str(source) in FLEET_HEURISTICS:
        return FLEET_HEURISTICS[str(source)]
    if str(source) == "rollout":
        return _rollout()
    shipped = {Path(file.name).stem: file for file in _SHIPPED.iterdir() if file.name.endswith(".npz")}
    location = Path(str(shipped[str(source)])) if str(source) in shipped else source
    with reached(location, PolicyError) as path:
        given, path = path, _weights_file(path, [*shipped, *FLEET_HEURISTICS, "rollout"])
        collection = read_policies(path, max_bytes=MAX_USER_BYTES if path == given else MAX_BYTES)
    kinds = {key.split("/")[1] for key in collection.weights}
    if len(kinds) == 1:
        (which,) = kinds
    try:
        name, index = collection.pick(axes)
        return TrainedPolicy.of(collection, name, index, which)
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from None


@lru_cache(maxsize=1)
def _rollout() -> Policy:
    return rollout_planner()


def _weights_file(path: Path, names: Sequence[str]) -> Path:
    """Return the file at a path, or that of the run whose folder is there; ``names`` are the policies that have one."""
    try:
        if path.is_dir():
            return path / WEIGHTS
        if not path.exists() and not path.suffix:
            hint = suggest(str(path), names)
            raise PolicyError(f"{path}: neither a file nor a policy by name; {hint}")
    except StoreError:
        raise
    except OSError as error:
        raise PolicyError(f"{path}: cannot be read: {reason_of(error)}") from None
    return path


def draws_scenarios(directory: Path) -> bool:
    """Return whether the agents of a run drew a fresh scenario in every episode, instead of having one each.

    Raises:
        PolicyError: the folder holds no weights, or they are damaged.
    """
    return bool(read_policies(directory / WEIGHTS, max_bytes=MAX_BYTES).drawn)

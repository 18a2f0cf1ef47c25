"""Policies by name or from files: heuristics, planners, and what a run has trained."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy
from uavmec_jax.errors import PolicyError
from uavmec_jax.files.validation import nearest
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.observation import FEATURES
from uavmec_jax.planning.rollout_planner import rollout_planner
from uavmec_jax.scenarios.distribution import unlike
from uavmec_jax.scenarios.policy_files import WEIGHTS, Collection, of_one, read_collection, sees_all, write_collection

_SHIPPED = resources.files("uavmec_jax.scenarios") / "library"
"""The policies that ship with the package."""


@dataclass(frozen=True, eq=False)
class TrainedPolicy:
    """The greedy policy of one trained agent; called as every policy, it makes its own observation.

    Attributes:
        algorithm: name of what trained it.
        trained_on: its value on every axis of the study: seed, powered and connected devices, ...
        n_devices: number of devices, fixed by the network; ``None`` where it plays any number.
        collection: the file's contents, of this agent alone.
    """

    algorithm: str
    trained_on: Mapping[str, Any]
    n_devices: int | None
    collection: Collection = field(repr=False)
    _act: Any = field(repr=False)
    _greedy: Any = field(repr=False)
    _appraise: Any = field(repr=False)

    @classmethod
    def of(cls, collection: Collection, name: str, place: int, which: str) -> "TrainedPolicy":
        """The policy of one agent of a collection."""
        weights = jax.tree.map(lambda leaf: jnp.asarray(leaf[place]), collection.weights_of(which, name))
        alone = of_one(collection, name, place, which)
        who = alone.agents[name][0]
        algorithm, hyper = alone.algorithm(name), alone.hyper(name, who)
        n_devices = None if sees_all(alone.settings[name]) else alone.n_devices
        greedy = partial(algorithm.greedy, hyper, weights)
        appraise = None
        if (critic := algorithm.critic) is not None:
            appraise = jax.jit(lambda *scene: critic(hyper, weights, algorithm.see(*scene)))
        act = jax.jit(algorithm.policy(hyper, weights))
        return cls(name, who, n_devices, alone, act, jax.jit(greedy), appraise)

    def __call__(self, params: Params, layout: Layout, state: State, key: Any = None) -> Array:
        """The device to visit, int32 ``[...]``, in states with any batch axes in front.

        Raises:
            PolicyError: the layout has another number of devices.
        """
        if self.n_devices not in (None, layout.capacity.shape[-1]):
            raise PolicyError(
                f"the policy was trained for {self.n_devices} devices; the layout has {layout.capacity.shape[-1]}"
            )
        chosen: Array = self._act(params, layout, state)
        return chosen

    def act(self, observation: Any) -> np.ndarray:
        """The device to visit for observations ``[..., words]``: NumPy in, NumPy int32 ``[...]`` out.

        Args:
            observation: the paper's, ``2n`` words; of a policy that plays any number of devices the full one, for each
                device its features and a 1 behind them.

        Raises:
            PolicyError: the observation has another shape, or holds what is no number.
        """
        try:
            given = np.asarray(observation, np.float32)
        except (TypeError, ValueError) as error:
            raise PolicyError(f"the observation is not an array of numbers: {error}") from None
        size = 2 * self.n_devices if self.n_devices else len(FEATURES) + 1
        words = given.shape[-1] if given.ndim else 0
        if words != size and (self.n_devices or words == 0 or words % size):
            wanted = f"({size},) or (..., {size})" if self.n_devices else f"(..., {size} for each device)"
            raise PolicyError(f"the observation has the shape {given.shape}; it should be {wanted}")
        return np.asarray(self._greedy(given))

    def appraise(self, params: Params, layout: Layout, states: State) -> Array:
        """What the critic says the rest of an episode is worth, f32 ``[B]``, in states with one batch axis.

        Raises:
            PolicyError: it was trained without a critic.
        """
        if self._appraise is None:
            raise PolicyError(f"{self.algorithm} has no critic; PPO and A2C have one")
        worth: Array = self._appraise(params, layout, states)
        return worth

    def unlike_training(self, params: Params, layout: Layout) -> list[str]:
        """In what a scenario lies outside those that the policy was trained on: a line each; none if it is like them.

        Of a policy that was trained on one scenario only nothing is known.
        """
        drawn = self.collection.drawn
        return unlike(drawn["scenarios"], drawn["params"], params, layout) if drawn else []

    def save(self, path: str | Path) -> None:
        """Write the policy to a file of its own (``.npz``), whole or not at all."""
        write_collection(Path(path), self.collection)


def load_policy(source: str | Path, which: str = "best", **axes: Any) -> Policy:
    """A policy by name, from a file, or of one agent of a run.

    Args:
        source: ``"generalist"``, a name in :data:`HEURISTICS`, ``"rollout"``, a policy file, or the folder of a run.
        which: ``"best"`` or ``"last"`` weights of a run's agent; a policy file has one kind.
        axes: which agent of a run, e.g. ``powered=8, connected=8, seed=3, algorithm="ppo"``; what tells no agents apart
            may be left out.

    Returns:
        ``policy(params, layout, state, key=None) -> action``; a :class:`TrainedPolicy` if it was trained.

    Raises:
        PolicyError: nothing of that name; a file that is damaged, altered or from another version; or no agent, or
            several, on those axes.
    """
    if str(source) in HEURISTICS:
        return HEURISTICS[str(source)]
    if str(source) == "rollout":
        return rollout_planner()
    shipped = {Path(file.name).stem: file for file in _SHIPPED.iterdir() if file.name.endswith(".npz")}
    path = Path(str(shipped.get(str(source), source)))
    if path.is_dir():
        path = path / WEIGHTS
    elif not path.exists() and not path.suffix:
        raise PolicyError(
            f"{source}: neither a file nor a policy by name; {nearest(str(source), [*shipped, *HEURISTICS, 'rollout'])}"
        )
    collection = read_collection(path)
    kinds = {key.split("/")[1] for key in collection.weights}
    try:
        name, place = collection.pick(axes)
        return TrainedPolicy.of(collection, name, place, next(iter(kinds)) if len(kinds) == 1 else which)
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from None


def draws_scenarios(directory: Path) -> bool:
    """Whether the agents of a run drew a fresh scenario in every episode, so that none belongs to one of them.

    Raises:
        PolicyError: the folder holds no weights, or they are damaged.
    """
    return bool(read_collection(directory / WEIGHTS).drawn)

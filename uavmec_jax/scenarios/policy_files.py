"""Files of trained policies: weights with everything that makes them policies, versioned, checked, without pickle.

A run leaves one collection of all its agents, ``weights.npz``; a policy saved on its own is a collection of one.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from uavmec_jax.agents.algorithm import Algorithm
from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.errors import PolicyError
from uavmec_jax.files.archives import read_checked, write_checked
from uavmec_jax.planning.observation import FEATURES

SCHEMA = 1
"""Version of the file."""

WEIGHTS = "weights.npz"
"""Name of a run's collection in its folder."""


@dataclass(frozen=True)
class PolicyCollection:
    """Trained agents.

    Attributes:
        settings: algorithm -> its settings, traced and static, as in a study.
        n_devices: number of devices.
        agents: algorithm -> one dictionary per agent: its value on every axis of the study.
        weights: ``<algorithm>/<best or last>/...``, leaves ``[A, ...]`` in the order of the agents.
        drawn: what the agents' scenarios were drawn from, the study's ``scenarios`` and ``params``; empty where each agent
            had one of its own.
    """

    settings: Mapping[str, Mapping[str, Any]]
    n_devices: int
    agents: Mapping[str, list[dict[str, Any]]]
    weights: Mapping[str, np.ndarray]
    drawn: Mapping[str, Any] = field(default_factory=dict)

    def weights_of(self, which: str, algorithm: str | None = None) -> dict[str, Any]:
        """Weights as the networks take them, leaves ``[A, ...]``; by default of the first algorithm.

        Raises:
            PolicyError: there are none.
        """
        name = next(iter(self.agents)) if algorithm is None else algorithm
        nested = traverse_util.unflatten_dict(dict(self.weights), sep="/")
        found: dict[str, Any] = nested.get(name, {}).get(which, {})
        if not found:
            kinds = sorted({kind for own in nested.values() for kind in own})
            raise PolicyError(
                f"there are no {which!r} weights of {name!r}; there are {' and '.join(kinds)} of {', '.join(nested)}"
            )
        return found

    def algorithm(self, name: str) -> Algorithm:
        """The algorithm of some of the agents, as far as policies need it."""
        return ALGORITHMS[name].make(self._settings(name), total_steps=1, n_devices=self.n_devices, max_age=1)

    def spec(self, name: str) -> Any:
        """The static settings of some of the agents."""
        return ALGORITHMS[name].spec_of(self._settings(name), n_devices=self.n_devices)

    def _settings(self, name: str) -> dict[str, Any]:
        """Settings of an algorithm; JSON has no tuples."""
        return {key: tuple(value) if isinstance(value, list) else value for key, value in self.settings[name].items()}

    def hyper(self, name: str, agent: Mapping[str, Any]) -> Any:
        """The hyperparameters of one agent."""
        values, declared = dict(self.settings[name]) | dict(agent), ALGORITHMS[name]
        return declared.hyper(**{key: values[key] for key in declared.traced})

    def pick(self, axes: Mapping[str, Any]) -> tuple[str, int]:
        """The algorithm and the place of the one agent that has the given values on its axes.

        Raises:
            PolicyError: none or several do, or there is no such axis.
        """
        everyone = [(name, place, who) for name, own in self.agents.items() for place, who in enumerate(own)]
        known = sorted({axis for *_, who in everyone for axis in who} | {"algorithm"})
        for axis in axes:
            if axis not in known:
                raise PolicyError(f"{axis!r} tells no agents apart; they have {', '.join(known)}")
        named = [(name, place, {"algorithm": name} | who) for name, place, who in everyone]
        found = [one for one in named if all(one[2].get(axis) == value for axis, value in axes.items())]
        if len(found) == 1:
            return found[0][:2]
        asked = ", ".join(f"{axis}={value}" for axis, value in axes.items()) or "anything"
        if not found:
            raise PolicyError(f"none of the {len(everyone)} agents has {asked}")
        differ = [axis for axis in known if len({str(who.get(axis)) for *_, who in found}) > 1]
        raise PolicyError(f"{len(found)} agents have {asked}; say which: they differ in {', '.join(differ)}")


def observes_devices(settings: Mapping[str, Any]) -> bool:
    """Whether an algorithm's policies see the full observation, and so play layouts of any number of devices."""
    return settings.get("observation") == "full"


def write_policies(path: Path, collection: PolicyCollection) -> None:
    """Write a collection, whole or not at all."""
    facts = {name: getattr(collection, name) for name in ("settings", "n_devices", "agents")}
    facts |= {"drawn": collection.drawn} if collection.drawn else {}
    if any(observes_devices(settings) for settings in collection.settings.values()):
        facts["features"] = [feature.name for feature in FEATURES]
    write_checked(path, SCHEMA, facts, collection.weights)


def read_policies(path: Path) -> PolicyCollection:
    """Read and check a collection.

    Raises:
        PolicyError: the file is not there, is damaged, was altered, is something else or from a newer version.
    """
    facts, weights = read_checked(path, SCHEMA, "a file of policies", PolicyError)
    if missing := {"settings", "n_devices", "agents"} - set(facts):
        raise PolicyError(f"{path}: is not a file of policies: its header has no {', '.join(sorted(missing))}")
    if facts.get("features", []) not in ([], [feature.name for feature in FEATURES]):
        raise PolicyError(
            f"{path}: its policies see other features of a device than those of this version; train again"
        )
    found = PolicyCollection(facts["settings"], facts["n_devices"], facts["agents"], weights, facts.get("drawn", {}))
    _check_shapes(path, found)
    return found


def _check_shapes(path: Path, collection: PolicyCollection) -> None:
    """The weights are those of the networks that the settings describe (another version may have had others)."""
    for name, agents in collection.agents.items():
        try:
            expectation = _shapes(collection, name)
        except (KeyError, TypeError, ValueError) as error:
            raise PolicyError(f"{path}: its {name} is not one that this version knows: {error}") from None
        for which in {key.split("/")[1] for key in collection.weights if key.startswith(f"{name}/")}:
            prefix = f"{name}/{which}/"
            found = {
                key.removeprefix(prefix): leaf.shape
                for key, leaf in collection.weights.items()
                if key.startswith(prefix)
            }
            if found != {key: (len(agents), *shape) for key, shape in expectation}:
                raise PolicyError(f"{path}: its weights do not fit its {name} network of this version")


def _shapes(collection: PolicyCollection, name: str) -> Iterable[tuple[str, tuple[int, ...]]]:
    spec = collection.spec(name)
    made: Any = jax.eval_shape(spec.network.init, jax.random.key(0), jnp.zeros((1, spec.obs_size)))
    return [(key, leaf.shape) for key, leaf in traverse_util.flatten_dict(made, sep="/").items()]


def select_agent(collection: PolicyCollection, name: str, place: int, which: str) -> PolicyCollection:
    """The collection of one agent and one kind of weights."""
    prefix = f"{name}/{which}/"
    return dataclasses.replace(
        collection,
        settings={name: collection.settings[name]},
        agents={name: [collection.agents[name][place]]},
        weights={key: leaf[place : place + 1] for key, leaf in collection.weights.items() if key.startswith(prefix)},
    )

"""Read and write trained policies: weights with all that is needed to use them, versioned, checked, without pickle.

A run writes one collection of all its agents, ``weights.npz``; a policy saved on its own is a collection of one.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from flax import traverse_util

from uavmec_jax.agents.algorithm import Algorithm
from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.errors import PolicyError
from uavmec_jax.files.archives import MAX_USER_BYTES, read_checked, write_checked
from uavmec_jax.planning.observation import FEATURES
from uavmec_jax.scenarios.policy_schema import check_header, check_weights, network_shapes

SCHEMA = 1
"""Version of the file format."""

WEIGHTS = "weights.npz"
"""Name of the file in the folder of a run."""


@dataclass(frozen=True)
class PolicyCollection:
    """Policies of trained agents.

    Attributes:
        settings: algorithm -> its settings, traced and static, as in a study.
        n_devices: number of devices.
        agents: algorithm -> one dictionary per agent: its value on every axis of the study.
        weights: ``<algorithm>/<best or last>/...``, leaves ``[A, ...]`` in the order of the agents.
        drawn: ``scenarios`` and ``params`` of a study whose scenarios are drawn; empty where each agent had one scenario.
    """

    settings: Mapping[str, Mapping[str, Any]]
    n_devices: int
    agents: Mapping[str, list[dict[str, Any]]]
    weights: Mapping[str, np.ndarray]
    drawn: Mapping[str, Any] = field(default_factory=dict)

    def weights_of(self, which: str, algorithm: str | None = None) -> dict[str, Any]:
        """Return weights as the networks take them, leaves ``[A, ...]``; by default those of the first algorithm.

        Raises:
            PolicyError: there are no such weights.
        """
        name = next(iter(self.agents)) if algorithm is None else algorithm
        nested = traverse_util.unflatten_dict(dict(self.weights), sep="/")
        weights: dict[str, Any] = nested.get(name, {}).get(which, {})
        if not weights:
            kinds = sorted({kind for by_kind in nested.values() for kind in by_kind})
            raise PolicyError(
                f"there are no {which!r} weights of {name!r}; there are {' and '.join(kinds)} of {', '.join(nested)}"
            )
        return weights

    def algorithm(self, name: str) -> Algorithm:
        """Return an algorithm by name; its policies are complete, the length of its training is not."""
        return ALGORITHMS[name].make(self._settings(name), total_steps=1, n_devices=self.n_devices, max_age=1)

    def spec(self, name: str) -> Any:
        """Return the static settings of an algorithm."""
        return ALGORITHMS[name].spec_of(self._settings(name), n_devices=self.n_devices)

    def _settings(self, name: str) -> dict[str, Any]:
        """Return the settings of an algorithm, JSON's arrays as tuples; settings newer than the file have their defaults."""
        stored = {key: tuple(value) if isinstance(value, list) else value for key, value in self.settings[name].items()}
        return ALGORITHMS[name].defaults | stored

    def hyper(self, name: str, agent: Mapping[str, Any]) -> Any:
        """Return the hyperparameters of one agent."""
        values, registered = self._settings(name) | dict(agent), ALGORITHMS[name]
        return registered.hyper(**{key: values[key] for key in registered.traced})

    def pick(self, axes: Mapping[str, Any]) -> tuple[str, int]:
        """Return the algorithm and the position of the only agent that has the given values on its axes.

        Raises:
            PolicyError: no agent has them, several have, or there is no such axis.
        """
        agents = [
            (name, index, {"algorithm": name} | agent_id)
            for name, agent_ids in self.agents.items()
            for index, agent_id in enumerate(agent_ids)
        ]
        all_axes = sorted({axis for *_, agent_id in agents for axis in agent_id})
        for axis in axes:
            if axis not in all_axes:
                raise PolicyError(f"{axis!r} is not an axis of the agents; they have {', '.join(all_axes)}")
        matches = [agent for agent in agents if all(agent[2].get(axis) == value for axis, value in axes.items())]
        if len(matches) == 1:
            return matches[0][:2]
        values = ", ".join(f"{axis}={value}" for axis, value in axes.items())
        if not matches:
            raise PolicyError(f"none of the {len(agents)} agents has {values}")
        differ = [axis for axis in all_axes if len({str(agent_id.get(axis)) for *_, agent_id in matches}) > 1]
        subject = f"{len(matches)} agents have {values}" if values else f"there are {len(matches)} agents"
        raise PolicyError(f"{subject}; say which: they differ in {', '.join(differ)}")


def observes_devices(settings: Mapping[str, Any]) -> bool:
    """Return whether policies with these settings take the full observation, and so any number of devices."""
    return settings.get("observation") == "full"


def write_policies(path: Path, collection: PolicyCollection) -> None:
    """Write a collection atomically."""
    facts = {name: getattr(collection, name) for name in ("settings", "n_devices", "agents")}
    facts |= {"drawn": collection.drawn} if collection.drawn else {}
    if any(observes_devices(settings) for settings in collection.settings.values()):
        facts["features"] = [feature.name for feature in FEATURES]
    write_checked(path, SCHEMA, facts, collection.weights)


def read_policies(path: Path, *, max_bytes: int = MAX_USER_BYTES) -> PolicyCollection:
    """Read and check a collection that takes at most ``max_bytes`` unpacked.

    Raises:
        PolicyError: the file is missing, damaged, altered, no policy file, or from another version, or something in it is
            not what it should be; one line.
    """
    facts, weights = read_checked(path, SCHEMA, "a file of policies", PolicyError, max_bytes=max_bytes)
    check_header(path, facts)
    if facts.get("features", []) not in ([], [feature.name for feature in FEATURES]):
        raise PolicyError(
            f"{path}: its policies see other features of a device than those of this version; train again"
        )
    collection = PolicyCollection(
        facts["settings"], facts["n_devices"], facts["agents"], weights, facts.get("drawn", {})
    )
    shapes = {name: network_shapes(collection.spec(name), len(agents)) for name, agents in collection.agents.items()}
    check_weights(path, weights, shapes)
    return collection


def select_agent(collection: PolicyCollection, name: str, index: int, which: str) -> PolicyCollection:
    """Return the collection of one agent and one kind of weights."""
    prefix = f"{name}/{which}/"
    return dataclasses.replace(
        collection,
        settings={name: collection.settings[name]},
        agents={name: [collection.agents[name][index]]},
        weights={key: leaf[index : index + 1] for key, leaf in collection.weights.items() if key.startswith(prefix)},
    )

"""The algorithms by name. Each is declared once: its traced hyperparameters, its static settings, and how to bind them."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from uavmec_jax.agents import a2c, dqn, ppo, pqn
from uavmec_jax.agents.algorithm import Algorithm

MAX_STEPS = 2_000_000_000
"""Most environment steps of one agent: counters are 32-bit integers, and whole iterations may go beyond it."""

_LAST = 2**31 - 1
"""Largest number that the counters hold."""

SCENARIO_SETTINGS = ("total_steps", "n_devices", "max_age")
"""Static settings that follow from the study and its scenarios, and are not set in files."""


@dataclass(frozen=True)
class RegisteredAlgorithm:
    """The declaration of an algorithm.

    Attributes:
        hyper: class of the traced hyperparameters, a pytree.
        spec: class of the static settings, a dataclass.
        bind: ``(spec) -> Algorithm``.
    """

    hyper: type
    spec: type
    bind: Callable[[Any], Algorithm]

    @property
    def traced(self) -> tuple[str, ...]:
        """Names of the hyperparameters that may differ between agents."""
        return tuple(field.name for field in dataclasses.fields(self.hyper))

    @property
    def static(self) -> tuple[str, ...]:
        """Names of the settings that shape the program."""
        names = (field.name for field in dataclasses.fields(self.spec))
        return tuple(name for name in names if name not in SCENARIO_SETTINGS)

    @property
    def defaults(self) -> dict[str, Any]:
        """The defaults of all settings, traced and static."""
        hyper, spec = self.hyper(), self.spec()
        return {name: getattr(hyper, name) for name in self.traced} | {
            name: getattr(spec, name) for name in self.static
        }

    def spec_of(self, settings: Mapping[str, Any], **sizes: int) -> Any:
        """Return the static settings: those in ``settings`` and, of ``sizes``, those that the algorithm has.

        Args:
            settings: all settings of the algorithm, traced and static.
            sizes: some of :data:`SCENARIO_SETTINGS`.
        """
        fields = {field.name for field in dataclasses.fields(self.spec)}
        static = {name: settings[name] for name in self.static}
        return self.spec(**static, **{name: size for name, size in sizes.items() if name in fields})

    def make(self, settings: Mapping[str, Any], *, total_steps: int, n_devices: int, max_age: int) -> Algorithm:
        """Return the algorithm with its static settings bound.

        Args:
            settings: all settings of the algorithm, traced and static.
            total_steps: environment steps of one agent.
            n_devices: number of devices.
            max_age: largest data age that can occur, slots.

        Raises:
            ValueError: settings contradict each other.
        """
        spec = self.spec_of(settings, total_steps=total_steps, n_devices=n_devices, max_age=max_age)
        algorithm = dataclasses.replace(self.bind(spec), spec=spec)
        _check_counters(algorithm)
        return algorithm


def _check_counters(algorithm: Algorithm) -> None:
    """Check that no counter of a training wraps: not that of the steps, nor the optimiser's of its updates.

    Raises:
        ValueError: one would; one line.
    """
    spec, per_iteration = algorithm.spec, algorithm.steps_per_iteration
    if algorithm.total_steps > _LAST:
        raise ValueError(
            f"n_steps is {spec.n_steps}; with n_envs = {spec.n_envs}, {algorithm.iterations:,} iterations of "
            f"{per_iteration:,} steps are {algorithm.total_steps:,}; there can be {_LAST:,}; lower n_steps, n_envs or steps"
        )
    updates = algorithm.iterations * getattr(spec, "n_epochs", 1) * getattr(spec, "minibatches", 1)
    if updates > _LAST:
        raise ValueError(
            f"n_epochs is {spec.n_epochs}; with batch_size = {spec.batch_size} and steps = {spec.total_steps:,}, there are "
            f"{updates:,} updates; there can be {_LAST:,}; lower n_epochs or steps, or raise batch_size"
        )


ALGORITHMS: Mapping[str, RegisteredAlgorithm] = MappingProxyType(
    {
        "dqn": RegisteredAlgorithm(dqn.DQNHyper, dqn.DQNSpec, dqn.algorithm),
        "pqn": RegisteredAlgorithm(pqn.PQNHyper, pqn.PQNSpec, pqn.algorithm),
        "ppo": RegisteredAlgorithm(ppo.PPOHyper, ppo.PPOSpec, ppo.algorithm),
        "a2c": RegisteredAlgorithm(a2c.A2CHyper, a2c.A2CSpec, a2c.algorithm),
    }
)
"""The algorithms by their names in study files."""


def check_end(algorithm: str, end: str, observation: str = "paper") -> None:
    """Check that an algorithm can be trained where episodes have a certain end.

    Args:
        algorithm: its name.
        end: what ends an episode, as in :class:`Params`.
        observation: what its network sees, ``paper`` or ``full``.

    Raises:
        ValueError: it is a DQN with the paper's observation, and episodes go on after a failure; one line.
    """
    if algorithm == "dqn" and end == "horizon" and observation == "paper":
        raise ValueError(
            "params.end is 'horizon', and algorithm is 'dqn', whose replay of the paper's observation holds no ages beyond "
            "their limit; give end = 'first_failure' or observation = 'full', or take 'pqn', 'ppo' or 'a2c'"
        )

"""The algorithms by name, each declared once: what may differ between agents, what shapes the program, how it is bound."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from uavmec_jax.agents import a2c, dqn, ppo
from uavmec_jax.agents.algorithm import Algorithm

SCENARIO_SETTINGS = ("total_steps", "n_devices", "max_age")
"""Static settings that follow from the study and its scenario."""


@dataclass(frozen=True)
class RegisteredAlgorithm:
    """One algorithm.

    Attributes:
        hyper: pytree of the traced hyperparameters.
        spec: dataclass of the static settings.
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

    def spec_of(self, settings: Mapping[str, Any], **sizes: int) -> Any:
        """The static settings among ``settings``, with those of :data:`SCENARIO_SETTINGS` that the algorithm has."""
        fields = {field.name for field in dataclasses.fields(self.spec)}
        chosen = {name: settings[name] for name in self.static}
        return self.spec(**chosen, **{name: size for name, size in sizes.items() if name in fields})

    def make(self, settings: Mapping[str, Any], *, total_steps: int, n_devices: int, max_age: int) -> Algorithm:
        """Bind the static settings among ``settings`` to a scenario's sizes.

        Raises:
            ValueError: they do not fit together.
        """
        return self.bind(self.spec_of(settings, total_steps=total_steps, n_devices=n_devices, max_age=max_age))


ALGORITHMS: Mapping[str, RegisteredAlgorithm] = MappingProxyType(
    {
        "dqn": RegisteredAlgorithm(dqn.DQNHyper, dqn.DQNSpec, dqn.algorithm),
        "ppo": RegisteredAlgorithm(ppo.PPOHyper, ppo.PPOSpec, ppo.algorithm),
        "a2c": RegisteredAlgorithm(a2c.A2CHyper, a2c.A2CSpec, a2c.algorithm),
    }
)
"""Name, as in study files -> declaration."""

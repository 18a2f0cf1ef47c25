"""The schema of policy files: what their header may say, and the weights that go with it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from uavmec_jax.agents.networks import weight_shapes
from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.agents.settings import SETTINGS
from uavmec_jax.env.params import MAX_DEVICES
from uavmec_jax.errors import PolicyError
from uavmec_jax.files.validation import PrintableText, StrictModel, suggest, validated
from uavmec_jax.scenarios.distribution import ScenarioSettings, check_scenarios
from uavmec_jax.scenarios.settings import ParamsSettings, check_ranges

KINDS = ("best", "last")
"""Which weights of an agent there are: those of the best validation, and those after the last step."""

_MAX_AGENTS = 1_000_000

_AxisValue = PrintableText | bool | int | float | None  # None: an infinite number, which JSON lacks
_Agent = dict[PrintableText, _AxisValue]

_COMPARED = (
    ("scenarios", ("devices", "region_m", "battery_factor", "hardware_factor", "uav_factor")),
    ("params", ("device_battery_range_j", "region_m", "uav_battery_j", "uav_speed_m_s")),
)
"""What a file has to say about the distribution of its scenarios, so that another scenario can be compared with it."""


class _Drawn(StrictModel):
    """The distribution that the agents' scenarios were drawn from."""

    scenarios: ScenarioSettings
    params: ParamsSettings

    @model_validator(mode="after")
    def _check(self) -> "_Drawn":
        for table, names in _COMPARED:
            for name in names:
                if name not in getattr(self, table).model_fields_set:
                    raise ValueError(f"drawn.{table}.{name} is missing")
        check_ranges(self.params, "drawn.params.")
        check_scenarios(self.scenarios, self.params.n_devices)
        return self


class PolicyHeader(StrictModel):
    """The header of a policy file."""

    schema_version: Annotated[int, Field(alias="schema")]
    package: PrintableText
    settings: Annotated[dict[str, dict[str, Any]], Field(min_length=1, max_length=len(ALGORITHMS))]
    n_devices: Annotated[int, Field(ge=1, le=MAX_DEVICES)]
    agents: dict[str, Annotated[list[_Agent], Field(min_length=1, max_length=_MAX_AGENTS)]]
    features: list[PrintableText] = Field(default_factory=list)
    """Names of the features of a device that the policies see."""
    drawn: _Drawn | None = None


def check_header(path: Path, header: Mapping[str, Any]) -> None:
    """Check the header of a policy file.

    Raises:
        PolicyError: a value is missing, unknown or not what it should be; one line.
    """
    if missing := {"settings", "n_devices", "agents"} - set(header):
        raise PolicyError(f"{path}: is not a file of policies: its header has no {', '.join(sorted(missing))}")
    checked = validated(PolicyHeader, dict(header), path, PolicyError)
    for name, settings in checked.settings.items():
        if name not in ALGORITHMS:
            raise PolicyError(
                f"{path}: settings.{name} is not an algorithm of this version; {suggest(name, ALGORITHMS)}"
            )
        if name not in checked.agents:
            raise PolicyError(f"{path}: agents.{name} is missing; settings.{name} is given")
        _check_settings(path, name, settings, checked)
    if unknown := [name for name in checked.agents if name not in checked.settings]:
        raise PolicyError(f"{path}: settings.{unknown[0]} is missing; agents.{unknown[0]} is given")


def _check_settings(path: Path, name: str, settings: Mapping[str, Any], header: PolicyHeader) -> None:
    """Check the settings of an algorithm, and the agents' values of those that may differ between agents."""
    model, registered = SETTINGS[name], ALGORITHMS[name]
    common = validated(model, settings, f"{path}: settings.{name}", PolicyError)
    try:
        registered.make(common.model_dump(), total_steps=1, n_devices=header.n_devices, max_age=1)
    except ValueError as error:
        raise PolicyError(f"{path}: settings.{name}: {error}") from None
    seen = {"{}"}  # many agents have the same values
    for number, agent in enumerate(header.agents[name], 1):
        own = {axis: value for axis, value in agent.items() if axis in registered.traced}
        if repr(own) not in seen:
            validated(model, own, f"{path}: agent {number} of {name}", PolicyError)
            seen.add(repr(own))


def check_weights(path: Path, weights: Mapping[str, np.ndarray], shapes: Mapping[str, Mapping[str, Any]]) -> None:
    """Check that there are weights for every algorithm, that they fit its network, and that they are of its type.

    Whether they are finite is checked where an agent is picked: that the training of one agent diverged says nothing about
    the others.

    Args:
        path: the file, for messages.
        weights: ``<algorithm>/<best or last>/...``, leaves ``[A, ...]``.
        shapes: algorithm -> name of a leaf -> shape ``(A, ...)``.

    Raises:
        PolicyError: weights are missing, unknown, or of another shape or type; one line.
    """
    expected = {
        f"{name}/{kind}/{leaf}": shape for name in shapes for kind in KINDS for leaf, shape in shapes[name].items()
    }
    for key, leaf in weights.items():
        name, _, _ = key.partition("/")
        if key not in expected or leaf.shape != expected[key]:
            raise PolicyError(f"{path}: its weights do not fit its {name} network of this version")
        if leaf.dtype != np.float32:
            raise PolicyError(f"{path}: weights {key} are of type {leaf.dtype}; they should be float32")
    for name in shapes:
        kinds = {kind for kind in KINDS for key in weights if key.startswith(f"{name}/{kind}/")}
        if not kinds or any(f"{name}/{kind}/{leaf}" not in weights for kind in kinds for leaf in shapes[name]):
            raise PolicyError(f"{path}: its weights do not fit its {name} network of this version")


def network_shapes(spec: Any, agents: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the weights of agents with the same static settings, by name; nothing is allocated."""
    return {name: (agents, *shape) for name, shape in weight_shapes(spec.network, spec.obs_size).items()}

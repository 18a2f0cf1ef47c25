"""The settings of the algorithms in files, traced and static, as validated models."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from uavmec_jax.agents.registry import ALGORITHMS, SCENARIO_SETTINGS
from uavmec_jax.files.validation import model_from_dataclasses

SETTINGS: Mapping[str, Any] = MappingProxyType(
    {
        name: model_from_dataclasses(
            f"{name.upper()}Settings", registered.hyper, registered.spec, leave_out=SCENARIO_SETTINGS
        )
        for name, registered in ALGORITHMS.items()
    }
)
"""Algorithm -> the model of its settings, made from the declarations in :data:`ALGORITHMS`."""

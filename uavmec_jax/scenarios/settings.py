"""Scenario parameters in files: :class:`Params` as a validated model."""

from typing import Any

from uavmec_jax.env.params import Params
from uavmec_jax.files.validation import model_from_dataclasses

ParamsSettings: Any = model_from_dataclasses("ParamsSettings", Params)


def unused_params(settings: Any) -> set[str]:
    """Return the names of the parameters without a meaning: those of a horizon, unless episodes end at one."""
    return set() if settings.end == "horizon" else {"end", "horizon_s", "end_share"}


def check_ranges(settings: Any, where: str) -> None:
    """Check that the lower end of every range of scenario parameters is positive and not above its upper end.

    Args:
        settings: scenario parameters.
        where: prefix of a parameter's name in messages.

    Raises:
        ValueError: one line that names the parameter.
    """
    for name in ("device_battery_range_j", "task_volume_range_bytes"):
        low, high = getattr(settings, name)
        if not 0 < low <= high:
            raise ValueError(f"{where}{name} is {[low, high]}; give [low, high] with 0 < low <= high")

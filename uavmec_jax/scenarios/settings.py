"""Scenario parameters in files: :class:`Params` as a validated model."""

from typing import Any

from uavmec_jax.env.checks import LARGEST, LEAST_CAPACITY_J, MAX_LENGTH_M, SMALLEST
from uavmec_jax.env.params import Params
from uavmec_jax.files.validation import model_from_dataclasses

ParamsSettings: Any = model_from_dataclasses("ParamsSettings", Params)


def unused_params(settings: Any) -> set[str]:
    """Return the names of the parameters without a meaning: those of a horizon, unless episodes end at one."""
    return set() if settings.end == "horizon" else {"end", "horizon_s", "end_share"}


def check_ranges(settings: Any, where: str) -> None:
    """Check that the lower end of every range of scenario parameters is positive and not above its upper end, and the sides.

    Args:
        settings: scenario parameters.
        where: prefix of a parameter's name in messages.

    Raises:
        ValueError: one line that names the parameter.
    """
    for name, least in (("device_battery_range_j", LEAST_CAPACITY_J), ("task_volume_range_bytes", SMALLEST)):
        low, high = getattr(settings, name)
        if not 0 < low <= high:
            raise ValueError(f"{where}{name} is {[low, high]}; give [low, high] with 0 < low <= high")
        if not least <= low <= high <= LARGEST:
            raise ValueError(f"{where}{name} is {[low, high]}; give numbers from {least:g} to {LARGEST:g}")
    if not all(side <= MAX_LENGTH_M for side in settings.region_m):
        raise ValueError(f"{where}region_m is {list(settings.region_m)}; give sides of at most {MAX_LENGTH_M:g} m")

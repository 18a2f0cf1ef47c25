"""Scenario parameters in files: :class:`Params` as a validated model."""

from typing import Any

from uavmec_jax.env.params import Params
from uavmec_jax.files.validation import model_from_dataclasses

MAX_POSITION_M = 1e7
"""Largest distance of a coordinate from the origin, m."""

MIN_SIDE_M = 1e-3
"""Shortest side of a region, m."""

MIN_CAPACITY_J = 1e-3
"""Smallest battery capacity of a device, J."""

ParamsSettings: Any = model_from_dataclasses("ParamsSettings", Params)


def unused_params(settings: Any) -> set[str]:
    """Return the names of the parameters without a meaning: those of a horizon, unless episodes end at one."""
    return set() if settings.end == "horizon" else {"end", "horizon_s", "end_share"}


def check_ranges(settings: Any, where: str) -> None:
    """Check that the lower end of every range of scenario parameters is positive and not above its upper end, and the region.

    Args:
        settings: scenario parameters.
        where: prefix of a parameter's name in messages.

    Raises:
        ValueError: one line that names the parameter.
    """
    for name, least in (("device_battery_range_j", MIN_CAPACITY_J), ("task_volume_range_bytes", 0)):
        low, high = getattr(settings, name)
        if not 0 < low <= high:
            raise ValueError(f"{where}{name} is {[low, high]}; give [low, high] with 0 < low <= high")
        if low < least:
            raise ValueError(f"{where}{name} is {[low, high]}; give at least {least:g}")
    if not all(MIN_SIDE_M <= side <= MAX_POSITION_M for side in settings.region_m):
        raise ValueError(
            f"{where}region_m is {list(settings.region_m)}; give two sides from {MIN_SIDE_M:g} to {MAX_POSITION_M:g} m"
        )

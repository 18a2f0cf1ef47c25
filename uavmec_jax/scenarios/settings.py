"""Scenario parameters in files: the checked form of :class:`Params`."""

from typing import Any

from uavmec_jax.env.params import Params
from uavmec_jax.files.validation import model_from_dataclasses

ParamsSettings: Any = model_from_dataclasses("ParamsSettings", Params)


def check_ranges(settings: Any, where: str) -> None:
    """Refuse ranges that are none; ``where`` stands before the name in the message.

    Raises:
        ValueError: one line.
    """
    for name in ("device_battery_range_j", "task_volume_range_bytes"):
        low, high = getattr(settings, name)
        if not 0 < low <= high:
            raise ValueError(f"{where}{name} is {[low, high]}; give [low, high] with 0 < low <= high")

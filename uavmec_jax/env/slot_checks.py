"""Checks of what a slot is given, actions and task volumes; see :mod:`uavmec_jax.env.checks`."""

from typing import Any

import jax
import numpy as np

from uavmec_jax.env.checks import LARGEST, Bounds, Check, check_ranges, check_shape
from uavmec_jax.errors import ArgumentError


def check_action(action: Any, n_places: int, axes: tuple[str, ...] = ("UAV",)) -> None:
    """Check an action, or a batch of them: places from 0, one per UAV. Quick where it is a single integer.

    Raises:
        ArgumentError: one line. A traced action passes, which :func:`transition` clamps; see :func:`debug_checks`.
    """
    number = action
    if isinstance(action, np.ndarray | np.generic | jax.Array) and not isinstance(action, jax.core.Tracer):
        array = np.asarray(action)
        number = array.item() if array.size == 1 and array.dtype.kind in "iu" else None
    if type(number) is int and 0 <= number < n_places:
        return
    check_ranges([action_check(action, n_places, axes)])


def action_check(action: Any, n_places: int, axes: tuple[str, ...] = ("UAV",)) -> Check:
    """Return the check of an action; that it holds integers is checked at once, since a dtype is never traced."""
    dtype = getattr(action, "dtype", None)
    if dtype is not None and dtype.kind not in "iu" and isinstance(action, jax.core.Tracer):
        raise ArgumentError(f"action has the dtype {dtype}; it should be an integer")
    return Check("action", action, Bounds(ge=0, le=n_places - 1, whole=True), axes)


def volumes_check(volumes: Any) -> Check:
    """Return the check of task volumes, bytes."""
    return Check("volumes", volumes, Bounds(ge=0, le=LARGEST), ("device",))


def check_volumes(volumes: Any, n_devices: int) -> None:
    """Check task volumes ``[..., n]``, bytes.

    Raises:
        ArgumentError: one line. Of traced volumes, only the shape is checked; see :func:`debug_checks`.
    """
    check_shape("volumes", volumes, (n_devices,), "one per device")
    check_ranges([volumes_check(volumes)])


def check_volume_table(volumes: Any, n_devices: int, batch: tuple[int, ...] = ()) -> None:
    """Check the task volumes of a number of slots, ``[*batch, H, n]``, bytes, of which there is at least one.

    Raises:
        ArgumentError: one line. Of traced volumes, only the shape is checked; see :func:`debug_checks`.
    """
    check_volumes(volumes, n_devices)
    shape = tuple(np.shape(volumes))
    if len(shape) != len(batch) + 2 or shape[:-2] != batch or shape[-2] == 0:
        axes = ", ".join((*map(str, batch), "slots", str(n_devices)))
        raise ArgumentError(f"volumes has shape {shape}; it should be ({axes}), with one slot or more")

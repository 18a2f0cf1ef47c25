"""Simulation parameters: those of Table 1 that all devices share, and switches for what the paper leaves open."""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from uavmec_jax.env.checks import (
    CAPACITY,
    LARGEST,
    MAX_LENGTH_M,
    SMALLEST,
    Bounds,
    Check,
    check_pair,
    check_range,
    check_ranges,
    check_rising,
)
from uavmec_jax.env.types import Range, Scalar
from uavmec_jax.errors import ArgumentError

MAX_DEVICES = 1000
"""Largest number of devices in a scenario."""

_POSITIVE, _NOT_NEGATIVE = {"ge": SMALLEST, "le": LARGEST}, {"ge": 0, "le": LARGEST}

ENDS = ("first_failure", "horizon")
"""What ends an episode. ``first_failure``: an empty battery, expired data or the UAVs' batteries, as in the paper.
``horizon``: a time or a share of the devices with empty batteries; devices fail one by one, and the others go on."""


@struct.dataclass
class Params:
    """Simulation parameters (paper, Table 1) in SI units: a frozen pytree whose leaves may all be traced.

    The defaults are the paper's. Only ``n_devices``, which is a shape, and ``end`` are static. The metadata of a field hold
    the bounds that files must respect (at least 0 if there are none). The last group of fields chooses between
    interpretations where the paper is ambiguous; ``docs/model.md`` explains each.
    """

    uav_speed_m_s: Scalar = struct.field(default=5.0, metadata=_POSITIVE)
    uav_flying_power_w: Scalar = struct.field(default=150.0, metadata=_NOT_NEGATIVE)
    uav_hovering_power_w: Scalar = struct.field(default=80.0, metadata=_POSITIVE)
    uav_signal_range_m: Scalar = struct.field(default=65.0, metadata={"ge": SMALLEST, "le": MAX_LENGTH_M})
    """Largest slant distance, which includes the altitude, at which a device is served."""
    uav_altitude_m: Scalar = struct.field(default=10.0, metadata={"ge": 0, "le": MAX_LENGTH_M})
    uav_battery_j: Scalar = struct.field(default=1_600_000.0, metadata=_POSITIVE)
    n_devices: int = struct.field(pytree_node=False, default=12, metadata={"ge": 2, "le": MAX_DEVICES})
    """Number of devices; as a setting at least 2. A scenario file, whose devices are counted, may hold a single one."""
    bandwidth_hz: Scalar = struct.field(default=20e6, metadata=_POSITIVE)
    noise_power_dbm: Scalar = struct.field(default=-100.0, metadata={"ge": -300, "le": 300})
    reference_gain_db_at_1m: Scalar = struct.field(default=-50.0, metadata={"ge": -300, "le": 300})
    path_loss_exponent: Scalar = struct.field(default=4.0, metadata={"ge": 0.1, "le": 10})
    transmit_power_w: Scalar = struct.field(default=0.1, metadata=_POSITIVE)
    device_battery_range_j: Range = (50_000.0, 80_000.0)
    task_volume_range_bytes: Range = (2e6, 4e6)
    data_age_limit_slots: Scalar = struct.field(default=10, metadata={"ge": 0, "le": 250})
    slot_cap_s: Scalar = struct.field(default=600.0, metadata=_POSITIVE)
    """Longest local processing time in a slot; work beyond it is dropped."""
    region_m: Range = (800.0, 800.0)
    result_message_bytes: Scalar = struct.field(default=1000.0, metadata=_NOT_NEGATIVE)

    uplink_rate_bit_s: Scalar = struct.field(default=math.inf, metadata={"ge": SMALLEST})
    """Rate at which connected devices that are not served send their results (not in the paper)."""
    flight_power_adds_to_hover: Scalar = False
    """Whether a slot of length T costs the UAV ``fly * t_fly + hover * T``, not ``fly * t_fly + hover * (T - t_fly)``."""
    count_unfinished_slot: Scalar = False
    """Whether the slot that the UAV's battery does not cover counts."""
    age_at_limit_fails: Scalar = False
    """Whether data expire when their age reaches the limit (``>=``), not when it exceeds it (``>``)."""
    max_slots: Scalar = struct.field(default=1000, metadata={"ge": 1, "le": 1_000_000})
    """Time limit of an episode (truncation), far beyond what the UAV's battery allows with the paper's parameters."""
    end: str = struct.field(pytree_node=False, default="first_failure", metadata={"choices": ENDS})
    """What ends an episode; see :data:`ENDS`."""
    horizon_s: Scalar = struct.field(default=43_200.0, metadata=_POSITIVE)
    """Seconds after which an episode ends, if ``end`` is ``horizon``."""
    end_share: Scalar = struct.field(default=1.0, metadata={"gt": 0, "le": 1})
    """Share of the devices with an empty battery at which an episode ends, if ``end`` is ``horizon``."""

    @property
    def noise_power_w(self) -> Float[Array, "*batch"]:
        """Channel noise power, W."""
        return 10.0 ** ((jnp.asarray(self.noise_power_dbm, jnp.float32) - 30.0) / 10.0)

    @property
    def reference_gain(self) -> Float[Array, "*batch"]:
        """Channel gain at 1 m, a ratio."""
        return 10.0 ** (jnp.asarray(self.reference_gain_db_at_1m, jnp.float32) / 10.0)


def leaf_dtype(default: bool | int | float) -> Any:
    """Return the dtype of a traced leaf whose default is a Python number: bool, int32 or float32."""
    return {bool: jnp.bool_, int: jnp.int32}.get(type(default), jnp.float32)


_STATIC = ("n_devices", "end")
_BOUNDS = {
    field.name: Bounds.of(field, LARGEST) for field in dataclasses.fields(Params) if field.name not in _STATIC
} | {
    "device_battery_range_j": CAPACITY,
    "region_m": Bounds(gt=0, le=MAX_LENGTH_M),
}
_RISING = ("device_battery_range_j", "task_volume_range_bytes")


def check_params(params: Params, name: str = "params") -> None:
    """Check every parameter that is known, of one scenario or of a batch.

    Raises:
        ArgumentError: one line that names the parameter. Traced ones pass, see :func:`um.debug_checks`.
    """
    check_range(f"{name}.n_devices", params.n_devices, ge=1, le=MAX_DEVICES, whole=True)
    if params.end not in ENDS:
        raise ArgumentError(f"{name}.end is {params.end!r}; it should be {' or '.join(map(repr, ENDS))}")
    checks = []
    for field, bounds in _BOUNDS.items():
        value = getattr(params, field)
        if type(value) is float and bounds.admits(value):  # most of them; the rest takes longer
            continue
        if isinstance(value, tuple | list):  # (low, high)
            check_pair(f"{name}.{field}", value)
            checks += [Check(f"{name}.{field} (value {k})", number, bounds) for k, number in enumerate(value, 1)]
        else:
            checks.append(Check(f"{name}.{field}", value, bounds))
    check_ranges(checks)
    check_pair(f"{name}.region_m", params.region_m)
    for field in _RISING:
        check_rising(f"{name}.{field}", getattr(params, field))

"""Fleets and depots: the UAVs of a scenario, and the places where they swap or charge their batteries."""

import enum
import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from uavmec_jax.env.checks import LARGEST, MAX_LENGTH_M, POSITION, Bounds, Check, check_range, check_ranges
from uavmec_jax.env.params import Params
from uavmec_jax.errors import ArgumentError

MAX_UAVS = 100
"""Largest number of UAVs in a scenario."""

DEPOT_POWER_W = 667.0
"""Default power of a charging depot, W: it charges the paper's UAV in 40 minutes."""


class DepotKind(enum.IntEnum):
    """What a depot does for a UAV that has landed there."""

    SWAP = 0
    """It swaps the battery for a full one, while it has packs."""
    CHARGE = 1
    """It charges the battery for the rest of the slot."""


@struct.dataclass
class Fleet:
    """The UAVs of a scenario; every field has one entry per UAV.

    Attributes:
        speed_m_s: m/s.
        flying_power_w: W.
        hovering_power_w: W.
        battery_j: battery capacity, J.
        signal_range_m: largest slant distance at which a device is served, m.
        start_m: position at the start, m.
        present: which entries are UAVs and not padding; ``None`` if all are. Padding is grounded from the start.
    """

    speed_m_s: Float[Array, "*batch K"]
    flying_power_w: Float[Array, "*batch K"]
    hovering_power_w: Float[Array, "*batch K"]
    battery_j: Float[Array, "*batch K"]
    signal_range_m: Float[Array, "*batch K"]
    start_m: Float[Array, "*batch K 2"]
    present: Bool[Array, "*batch K"] | None = None


@struct.dataclass
class Depots:
    """The depots of a scenario; every field has one entry per depot.

    Attributes:
        position: coordinates in the region, m.
        kind: a :class:`DepotKind`.
        pads: UAVs that are served in one slot, the lowest numbers first; the others wait. Padding has none.
        packs: full batteries in stock at the start; only swapping takes them.
        power_w: power per UAV of a charging depot, W.
    """

    position: Float[Array, "*batch D 2"]
    kind: Int[Array, "*batch D"]
    pads: Float[Array, "*batch D"]
    packs: Float[Array, "*batch D"]
    power_w: Float[Array, "*batch D"]


UAV_FIELDS = ("speed_m_s", "flying_power_w", "hovering_power_w", "battery_j", "signal_range_m")
"""Fields of a :class:`Fleet` whose defaults are the parameters of the same name prefixed with ``uav_``."""


_POSITIVE, _NOT_NEGATIVE = Bounds(gt=0, le=LARGEST), Bounds(ge=0, le=LARGEST)
FLEET_BOUNDS = dict.fromkeys(UAV_FIELDS, _POSITIVE) | {
    "flying_power_w": _NOT_NEGATIVE,
    "signal_range_m": Bounds(gt=0, le=MAX_LENGTH_M),
}
"""Ranges of the fields of a :class:`Fleet`."""

DEPOT_BOUNDS = {"pads": Bounds(ge=1, infinite=True), "packs": Bounds(ge=0, infinite=True), "power_w": _NOT_NEGATIVE}
"""Ranges of the fields of :class:`Depots`; padding has no pads."""


def make_fleet(params: Params, uavs: int, depots: Depots | None = None, **values: ArrayLike | Sequence) -> Fleet:
    """Return a fleet of ``uavs`` UAVs like that of the parameters, except for the given values.

    Args:
        params: simulation parameters.
        uavs: number of UAVs, at least 1.
        depots: UAV ``v`` starts at depot ``v mod D``; without depots, at the origin.
        values: fields of :class:`Fleet`, a number for all UAVs or one per UAV; e.g. ``battery_j=[1.6e6, 0.8e6]``.

    Raises:
        ArgumentError: a number is out of range, or there are too few or too many, one line that names the field.
        TypeError: a name is not that of a field.
    """
    check_range("uavs", uavs, ge=1, le=MAX_UAVS, whole=True)
    start = default_start(uavs, depots) if (given := values.pop("start_m", None)) is None else given
    present = values.pop("present", None)
    defaults: dict[str, Any] = {name: getattr(params, f"uav_{name}") for name in UAV_FIELDS}
    if unknown := set(values) - set(defaults):
        names = ", ".join((*UAV_FIELDS, "start_m", "present"))
        raise TypeError(f"{sorted(unknown)[0]} is not a field of a fleet; fields are {names}")
    fields = {name: _one_each(name, value, (uavs,)) for name, value in (defaults | values).items()}
    start = _one_each("start_m", start, (uavs, 2))
    checks = [Check(name, value, FLEET_BOUNDS[name], ("UAV",)) for name, value in fields.items()]
    check_ranges([*checks, Check("start_m", start, POSITION, ("UAV", ""))])
    return Fleet(
        **fields,
        start_m=start,
        present=None if present is None else _one_each("present", present, (uavs,), bool),
    )


def make_depots(
    position: Sequence[Sequence[float]] | Float[ArrayLike, "D 2"],
    kind: str | Sequence[str] = "swap",
    pads: ArrayLike | Sequence[float] = math.inf,
    packs: ArrayLike | Sequence[float] = math.inf,
    power_w: ArrayLike | Sequence[float] = DEPOT_POWER_W,
) -> Depots:
    """Return depots; each argument but the positions is one value for all or one per depot.

    Args:
        position: ``[D, 2]`` m.
        kind: ``"swap"`` or ``"charge"``.
        pads: UAVs that are served in one slot.
        packs: full batteries in stock.
        power_w: charging power per UAV, W.

    Raises:
        ArgumentError: a kind is unknown, a number is out of range, or there are too few or too many, one line that names the
            field.
    """
    position = _real("position", position).reshape(-1, 2)
    count = position.shape[0]
    kinds = [kind] * count if isinstance(kind, str) else list(kind)
    if len(kinds) != count:
        raise ArgumentError(f"kind has {len(kinds)} values; give one for all or {count}, one per depot")
    names = [member.name.lower() for member in DepotKind]
    for number, name in enumerate(kinds, 1):
        if name not in names:
            raise ArgumentError(f"kind of depot {number} is {name!r}; give {' or '.join(map(repr, names))}")
    numbers = {
        name: _one_each(name, value, (count,))
        for name, value in (("pads", pads), ("packs", packs), ("power_w", power_w))
    }
    checks = [Check(name, value, DEPOT_BOUNDS[name], ("depot",)) for name, value in numbers.items()]
    check_ranges([Check("position", position, POSITION, ("depot", "")), *checks])
    return Depots(position=position, kind=jnp.asarray([names.index(name) for name in kinds], jnp.int32), **numbers)


def default_start(uavs: int, depots: Depots | None) -> Float[Array, "K 2"]:
    """Return where UAVs start if nothing else is said: UAV ``v`` at depot ``v mod D``; without depots, at the origin."""
    if depots is None or depots.kind.shape[-1] == 0:
        return jnp.zeros((uavs, 2), jnp.float32)
    return depots.position[np.arange(uavs) % depots.kind.shape[-1]]


def _one_each(name: str, value: Any, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
    """Return one value for each UAV or depot, given one for all or one for each."""
    array = _real(name, value, dtype)
    if array.shape not in (shape, shape[1:]):
        raise ArgumentError(f"{name} has shape {array.shape}; it should be {shape}, or {shape[1:]} for all alike")
    return jnp.broadcast_to(array, shape)


def _real(name: str, value: Any, dtype: Any = jnp.float32) -> Array:
    """Return a value as an array of real numbers; what is too large becomes infinite, which checks refuse."""
    if np.iscomplexobj(value):
        raise ArgumentError(f"{name} is complex; it should be real numbers")
    with np.errstate(over="ignore"):
        return jnp.asarray(value, dtype)

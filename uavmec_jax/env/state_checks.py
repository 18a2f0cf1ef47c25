"""Checks of states; see :mod:`uavmec_jax.env.checks`."""

from typing import Any

from uavmec_jax.env.checks import LARGEST, POSITION, Bounds, Check, check_bool, check_ranges, check_shape, is_traced
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.scenario_checks import check_scenario

_ENERGY = Bounds(ge=0, le=LARGEST)
_WHOLE = Bounds(ge=0, lt=2**31, whole=True)
_FAILED_AT = Bounds(ge=-1, lt=2**31, whole=True)
_PACKS = Bounds(ge=0, infinite=True)


def state_checks(state: Any, name: str = "state") -> list[Check]:
    """Return the checks of all values of a :class:`State`."""
    checks = [
        Check(f"{name}.battery", state.battery, _ENERGY, ("device",)),
        Check(f"{name}.age", state.age, _WHOLE, ("device",)),
        Check(f"{name}.uav_energy", state.uav_energy, _ENERGY, ("UAV",)),
        Check(f"{name}.uav_position", state.uav_position, POSITION, ("UAV", "")),
        Check(f"{name}.slot", state.slot, _WHOLE),
        Check(f"{name}.elapsed", state.elapsed, Bounds(ge=0, le=LARGEST)),
    ]
    optional = (
        Check(f"{name}.failed_at", state.failed_at, _FAILED_AT, ("device",)),
        Check(f"{name}.packs", state.packs, _PACKS, ("depot",)),
    )
    return checks + [check for check in optional if check.value is not None]


def check_decision(params: Any, layout: Layout, state: Any) -> None:
    """Check all that a policy decides on, unless any of it is traced.

    Raises:
        ArgumentError: one line.
    """
    if not is_traced((params, layout, state)):
        check_scenario(params, layout)
        check_state(layout, state)


def check_state(layout: Layout, state: Any, name: str = "state") -> None:
    """Check every value of a state that is known, and that it fits its layout.

    Raises:
        ArgumentError: one line that names the field and the device or UAV.
    """
    n, uavs, depots = layout.n_devices, layout.n_uavs, layout.n_depots
    for field, shape, what in (
        ("battery", (n,), "one per device"),
        ("age", (n,), "one per device"),
        ("uav_energy", (uavs,), "one per UAV"),
        ("uav_position", (uavs, 2), "x and y of each UAV"),
        ("grounded", (uavs,), "one per UAV"),
        ("failed_at", (n,), "one per device"),
        ("packs", (depots,), "one per depot"),
    ):
        if (value := getattr(state, field)) is not None:
            check_shape(f"{name}.{field}", value, shape, what)
    if state.grounded is not None:
        check_bool(f"{name}.grounded", state.grounded)
    check_ranges(state_checks(state, name))

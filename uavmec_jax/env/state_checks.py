"""Checks of states; see :mod:`uavmec_jax.env.checks`."""

from uavmec_jax.env.checks import LARGEST, POSITION, Bounds, Check, check_ranges, check_shape
from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout


def check_state(layout: Layout, state: State, name: str = "state") -> None:
    """Check every value of a state that is known, and that it fits its layout.

    Raises:
        ArgumentError: one line that names the field and the device or UAV.
    """
    n, uavs = layout.n_devices, layout.n_uavs
    for field, shape, what in (
        ("battery", (n,), "one per device"),
        ("age", (n,), "one per device"),
        ("uav_energy", (uavs,), "one per UAV"),
        ("uav_position", (uavs, 2), "x and y of each UAV"),
    ):
        check_shape(f"{name}.{field}", getattr(state, field), shape, what)
    energy = Bounds(ge=0, le=LARGEST)
    check_ranges(
        [
            Check(f"{name}.battery", state.battery, energy, ("device",)),
            Check(f"{name}.age", state.age, Bounds(ge=0, whole=True), ("device",)),
            Check(f"{name}.uav_energy", state.uav_energy, energy, ("UAV",)),
            Check(f"{name}.uav_position", state.uav_position, POSITION, ("UAV", "")),
            Check(f"{name}.slot", state.slot, Bounds(ge=0, whole=True)),
            Check(f"{name}.elapsed", state.elapsed, Bounds(ge=0, le=LARGEST)),
        ]
    )

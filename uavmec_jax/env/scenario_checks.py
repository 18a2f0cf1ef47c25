"""Checks of whole layouts, with their UAVs and depots, and of scenarios; see :mod:`uavmec_jax.env.checks`."""

from uavmec_jax.env.checks import LARGEST, POSITION, Bounds, Check, check_bool, check_ranges, check_shape
from uavmec_jax.env.fleet import DEPOT_BOUNDS, FLEET_BOUNDS, DepotKind, Depots, Fleet
from uavmec_jax.env.layout import DEVICE_BOUNDS, Layout, Traffic
from uavmec_jax.env.params import Params, check_params
from uavmec_jax.errors import ArgumentError


def check_layout(layout: Layout, params: Params | None = None, name: str = "layout") -> None:
    """Check every value of a layout that is known, of one scenario or of a batch, and all shapes.

    Args:
        layout: the devices, the UAVs and the depots.
        params: if given, the layout should have their number of devices; one with padding may have more entries.
        name: of the layout in messages.

    Raises:
        ArgumentError: one line that names the field and the device, the UAV or the depot. Traced values pass, see
            :func:`um.debug_checks`.
    """
    n = layout.n_devices
    padded = layout.present is not None
    if params is not None and n != params.n_devices and not (padded and n > params.n_devices):
        raise ArgumentError(f"{name} has {n} devices; it should have params.n_devices = {params.n_devices} of them")
    check_shape(f"{name}.position", layout.position, (n, 2), "x and y of each device")
    checks = [Check(f"{name}.position", layout.position, POSITION, ("device", ""))]
    for field, bounds in DEVICE_BOUNDS.items():
        value = getattr(layout, field)
        check_shape(f"{name}.{field}", value, (n,), "one per device")
        checks.append(Check(f"{name}.{field}", value, bounds, ("device",)))
    for field in ("has_power", "has_comms", "present"):
        if (value := getattr(layout, field)) is not None:
            check_shape(f"{name}.{field}", value, (n,), "one per device")
            check_bool(f"{name}.{field}", value)
    if layout.priority is not None:
        check_shape(f"{name}.priority", layout.priority, (n,), "one per device")
        checks.append(Check(f"{name}.priority", layout.priority, Bounds(ge=0, le=LARGEST), ("device",)))
    if layout.traffic is not None:
        checks += _of_traffic(layout.traffic, n, f"{name}.traffic")
    if layout.fleet is not None:
        checks += _of_fleet(layout.fleet, f"{name}.fleet")
    if layout.depots is not None:
        checks += _of_depots(layout.depots, f"{name}.depots")
    check_ranges(checks)


def _of_traffic(traffic: Traffic, n: int, name: str) -> list[Check]:
    """Return the checks of the traffic around ``n`` devices."""
    check_shape(f"{name}.weight", traffic.weight, (n,), "one per device in each window")
    return [
        Check(f"{name}.weight", traffic.weight, Bounds(ge=0, le=1), ("window", "device")),
        Check(f"{name}.window_s", traffic.window_s, Bounds(gt=0, infinite=True)),
        Check(f"{name}.price", traffic.price, Bounds(ge=0, le=LARGEST)),
    ]


def _of_fleet(fleet: Fleet, name: str) -> list[Check]:
    """Return the checks of UAVs."""
    uavs = fleet.speed_m_s.shape[-1]
    check_shape(f"{name}.start_m", fleet.start_m, (uavs, 2), "x and y of each UAV")
    checks = [Check(f"{name}.start_m", fleet.start_m, POSITION, ("UAV", ""))]
    for field, bounds in FLEET_BOUNDS.items():
        check_shape(f"{name}.{field}", getattr(fleet, field), (uavs,), "one per UAV")
        checks.append(Check(f"{name}.{field}", getattr(fleet, field), bounds, ("UAV",)))
    return checks


def _of_depots(depots: Depots, name: str) -> list[Check]:
    """Return the checks of depots; padding has no pads."""
    count = depots.kind.shape[-1]
    check_shape(f"{name}.position", depots.position, (count, 2), "x and y of each depot")
    checks = [Check(f"{name}.position", depots.position, POSITION, ("depot", ""))]
    kind = Bounds(ge=0, le=len(DepotKind) - 1, whole=True)
    for field, bounds in {"kind": kind, **DEPOT_BOUNDS, "pads": Bounds(ge=0, infinite=True)}.items():
        check_shape(f"{name}.{field}", getattr(depots, field), (count,), "one per depot")
        checks.append(Check(f"{name}.{field}", getattr(depots, field), bounds, ("depot",)))
    return checks


def check_scenario(params: Params, layout: Layout) -> None:
    """Check all values that are known of the parameters and the layout, and that they fit together.

    Raises:
        ArgumentError: one line.
    """
    check_params(params)
    check_layout(layout, params)

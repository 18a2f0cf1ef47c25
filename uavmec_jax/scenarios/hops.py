"""Check that the batteries of a scenario's UAVs are large enough for its distances."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from uavmec_jax.env.fleet import Fleet
from uavmec_jax.scenarios.region import Positions
from uavmec_jax.scenarios.schema import ScenarioFile, label


def check_hops(file: ScenarioFile, fleet: Fleet | None, positions: Positions) -> None:
    """Check that a full battery pays for the flight between any two places.

    Args:
        file: contents of the scenario file.
        fleet: the UAVs, ``None`` for the one of the parameters, which also flies to all places from its start.
        positions: all positions.

    Raises:
        ValueError: no UAV can pay for a hop, or a UAV reaches no place from its start; one line.
    """
    if fleet is None:
        start = positions.depots[:1] if file.depot else np.zeros((1, 2))
        _check_one(file, np.concatenate([start, positions.places]))
    else:
        _check_fleet(file, fleet, positions)


def _check_one(file: ScenarioFile, stops: Float[np.ndarray, "m 2"]) -> None:
    """Check that the UAV of the parameters can pay for all hops between its start and the places."""
    power, speed, battery = (
        getattr(file.params, f"uav_{name}") for name in ("flying_power_w", "speed_m_s", "battery_j")
    )
    energy = lambda metres: power * metres / speed  # noqa: E731
    if (hop := _first_hop(stops, lambda metres: energy(metres) > battery)) is not None:
        names, (here, there, metres) = ["the start", *file.place_names], hop
        raise ValueError(
            f"the hop from {names[here]} to {names[there]}, {metres:,.0f} m, takes {energy(metres) / 1e3:,.0f} kJ; "
            f"the UAV's battery holds {battery / 1e3:,.0f} kJ (params.uav_battery_j)"
        )


def _check_fleet(file: ScenarioFile, fleet: Fleet, positions: Positions) -> None:
    """Check that some UAV can pay for each hop, and that each UAV reaches a place from its start."""
    battery, speed, power = (
        np.asarray(values, float) for values in (fleet.battery_j, fleet.speed_m_s, fleet.flying_power_w)
    )
    reach = np.where(power > 0, battery * speed / np.where(power > 0, power, 1.0), np.inf)
    places, names, furthest = positions.places, file.place_names, int(np.argmax(reach))
    if (hop := _first_hop(places, lambda metres: metres > reach[furthest])) is not None:
        here, there, metres = hop
        raise ValueError(
            f"the hop from {names[here]} to {names[there]} is {metres:,.0f} m long; {file.uav_names[furthest]}, which flies "
            f"furthest on a full battery, can fly at most {reach[furthest]:,.0f} m; give it more battery_j or "
            "move the places closer"
        )
    distance = np.hypot(*np.moveaxis(positions.starts[:, None] - places, -1, 0))
    nearest, metres = np.argmin(distance, axis=1), np.min(distance, axis=1)
    if np.any(metres > reach):
        number = int(np.argmax(metres > reach))
        raise ValueError(
            f"{label('uav', number + 1, file.uav[number].name)}: reaches no place from its start: it flies "
            f"{reach[number]:,.0f} m on a full battery, and {names[nearest[number]]}, the nearest, is "
            f"{metres[number]:,.0f} m away; move its start or give more battery_j"
        )


def _first_hop(
    stops: Float[np.ndarray, "m 2"], is_too_long: Callable[[Float[np.ndarray, "m m"]], Bool[np.ndarray, "m m"]]
) -> tuple[int, int, float] | None:
    """Return the first two stops, by their numbers, that are too far apart, and their distance in m; ``None`` if none are."""
    metres = np.hypot(*(np.subtract.outer(axis, axis) for axis in stops.T))
    too_long = np.triu(is_too_long(metres), 1)
    if not too_long.any():
        return None
    here, there = divmod(int(np.argmax(too_long)), len(stops))
    return here, there, float(metres[here, there])

"""A plan on the map: GeoJSON (RFC 7946) with the devices as points and the tours as lines."""

from typing import Any

import numpy as np

from uavmec_jax.planning.plan import Plan
from uavmec_jax.scenarios.named_scenario import NamedScenario


def tour_geojson(scenario: NamedScenario, plan: Plan) -> dict[str, Any]:
    """Return a feature collection; coordinates are longitude and latitude in degrees.

    Args:
        scenario: what was planned for.
        plan: its tours, slot by slot.

    Raises:
        ScenarioError: the scenario has no geographic position.
    """
    devices = scenario.geographic(np.asarray(plan.layout.position))
    visits = {name: np.bincount(tour.action, minlength=len(devices)) for name, tour in plan.tours.items()}
    points = [
        _feature(
            "Point",
            devices[i].tolist(),
            {
                "number": i + 1,
                "name": name,
                "power": bool(plan.layout.has_power[i]),
                "comms": bool(plan.layout.has_comms[i]),
                "fails_first_share": float(plan.forecast.first_failure[i]),
                **{f"visits_{tour}": int(count[i]) for tour, count in visits.items()},
            },
        )
        for i, name in enumerate(scenario.device_names)
    ]
    lines = []
    for name, tour in plan.tours.items():
        stops = np.concatenate([np.zeros((1, 2)), plan.layout.position[tour.action]])
        moved = np.append(True, np.any(np.diff(stops, axis=0) != 0, axis=1))
        path = scenario.geographic(stops[moved]).tolist()
        path = path if len(path) > 1 else path * 2  # a line has at least two positions
        properties = {
            "tour": name,
            "devices": [int(action) + 1 for action in tour.action],
            "mean_lifetime_slots": float(plan.lifetimes[name].mean()),
        }
        lines.append(_feature("LineString", path, properties))
    return {"type": "FeatureCollection", "features": [*points, *lines]}


def _feature(geometry: str, coordinates: list, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": geometry, "coordinates": coordinates}, "properties": properties}

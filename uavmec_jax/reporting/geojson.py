"""A plan on the map: GeoJSON (RFC 7946) with devices and depots as points, tours as lines, the region as a polygon.

Longitudes stay from -180 to 180; what crosses the antimeridian is cut there.
"""

import math
from typing import Any

import numpy as np

from uavmec_jax.env.fleet import DepotKind
from uavmec_jax.env.rollout import Trace
from uavmec_jax.planning.plan import Plan
from uavmec_jax.reporting.antimeridian import line_geometry, polygon_geometry
from uavmec_jax.reporting.tours import targets, uav_stops
from uavmec_jax.scenarios.named_scenario import NamedScenario


def tour_geojson(scenario: NamedScenario, plan: Plan) -> dict[str, Any]:
    """Return a feature collection; coordinates are longitude and latitude in degrees.

    Args:
        scenario: what was planned for.
        plan: its tours, slot by slot.

    Raises:
        ScenarioError: the scenario has no geographic position.
    """
    features = [*_devices(scenario, plan), *_depots(scenario, plan)]
    for name, tour in plan.tours.items():
        features += [_line(scenario, plan, name, tour, uav) for uav in range(plan.layout.n_uavs)]
    return {"type": "FeatureCollection", "features": features + _region(scenario)}


def _devices(scenario: NamedScenario, plan: Plan) -> list[dict[str, Any]]:
    """Return the devices; visits count the slots in which a UAV flies to them, or stays."""
    devices = scenario.geographic(np.asarray(plan.layout.position))
    visits = {
        name: np.bincount(1 + targets(tour).reshape(-1), minlength=1 + len(devices))[1:]
        for name, tour in plan.tours.items()
    }
    priority = plan.layout.priority
    return [
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
                **({} if priority is None else {"priority": float(priority[i])}),
            },
        )
        for i, name in enumerate(scenario.device_names)
    ]


def _depots(scenario: NamedScenario, plan: Plan) -> list[dict[str, Any]]:
    if (depots := plan.layout.depots) is None:
        return []
    positions = scenario.geographic(np.asarray(depots.position))
    return [
        _feature(
            "Point",
            positions[d].tolist(),
            {
                "depot": d + 1,
                "name": name,
                "kind": DepotKind(int(depots.kind[d])).name.lower(),
                "pads": _count(float(depots.pads[d])),
                "packs": _count(float(depots.packs[d])) if depots.kind[d] == DepotKind.SWAP else None,
                "power_w": float(depots.power_w[d]) if depots.kind[d] == DepotKind.CHARGE else None,
            },
        )
        for d, name in enumerate(scenario.depot_names)
    ]


def _count(number: float) -> int | None:
    """Return a number of pads or packs; ``None`` for any number."""
    return int(number) if math.isfinite(number) else None


def _line(scenario: NamedScenario, plan: Plan, name: str, tour: Trace, uav: int) -> dict[str, Any]:
    """Return the tour of one UAV; it ends where the UAV was grounded."""
    stops = uav_stops(plan, tour, uav)
    moved = np.append(True, np.any(np.diff(stops, axis=0) != 0, axis=1))
    path = scenario.geographic(stops[moved])
    path = path if len(path) > 1 else path.repeat(2, axis=0)  # a line has at least two positions
    places = [int(place) + 1 for place in targets(tour)[:, uav] if place >= 0]
    properties: dict[str, Any] = {"tour": name}
    if plan.as_in_paper:
        properties["devices"] = places
    else:
        grounded = tour.state.grounded[:, uav]
        properties |= {
            "uav": scenario.uav_names[uav],
            "places": [scenario.place_names[place - 1] for place in places],
            "grounded_in_slot": int(np.argmax(grounded)) + 1 if grounded.any() else None,
        }
    if plan.service is None:
        properties["mean_lifetime_slots"] = float(plan.lifetimes[name].mean())
    else:
        properties["mean_service_share"] = float(plan.service[name].mean())
    return _feature(*line_geometry(path), properties)


def _region(scenario: NamedScenario) -> list[dict[str, Any]]:
    """Return the polygon of the region, if the file gives one; the last position repeats the first."""
    if (corners := scenario.region_corners) is None:
        return []
    return [_feature(*polygon_geometry(scenario.geographic(corners)), {"region": scenario.name})]


def _feature(geometry: str, coordinates: list, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": geometry, "coordinates": coordinates}, "properties": properties}

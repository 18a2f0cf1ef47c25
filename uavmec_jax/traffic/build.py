"""Build an evacuation: network, demand, simulations, devices, weights."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from uavmec_jax.traffic import sumo
from uavmec_jax.traffic.demand import find_routes
from uavmec_jax.traffic.devices import check_devices, place_devices
from uavmec_jax.traffic.evacuation import Evacuation
from uavmec_jax.traffic.network import build_network
from uavmec_jax.traffic.place import Place
from uavmec_jax.traffic.simulation import simulate
from uavmec_jax.traffic.weights import density_near, scaled
from uavmec_jax.traffic.workspace import Workshop


def build_evacuation(
    place: Place, folder: Path, *, command: str = "", on_progress: Callable[[str], None] = lambda _: None
) -> Evacuation:
    """Simulate the evacuation of a place, and see what its devices see of it.

    Args:
        place: from :func:`uavmec_jax.traffic.place.load_place`.
        folder: that the place's paths start from.
        command: the command line, for the label.
        on_progress: told in words what was just done.

    Raises:
        TrafficError: a file is not usable, SUMO is missing or fails, or the place makes no sense; one line.
    """
    with Workshop() as workshop:
        network = build_network(place.network, folder, workshop)
        on_progress(f"network: {len(network.roads):,} roads, {len(network.junctions):,} junctions")
        routes = find_routes(network, place.demand, place.name)
        check_devices(place, network, routes)
        on_progress(
            f"demand: {len(routes.origins):,} origins, {len(routes.exits)} exits, {place.demand.vehicles:,} vehicles"
        )
        found = simulate(
            network,
            routes,
            place.demand,
            place.simulation,
            workshop,
            lambda done: on_progress(f"simulation {done} of {place.simulation.seeds}"),
        )
    first, last = place.simulation.windows
    names, position = place_devices(place, network, routes, found.density[:, first:last].mean(axis=(0, 1)))
    near = density_near(position, network.shapes, network.lanes, found.density, place.devices.radius_m)  # [S, W, n]
    each = near[:, first:last].mean(axis=1)
    meta = {
        "place": place.name,
        "description": place.description,
        "names": names,
        "roads": list(network.roads),
        "window_s": place.simulation.window_s,
        "mean_s": [first * place.simulation.window_s, last * place.simulation.window_s],
        "mean_windows": [first, last],
        "radius_m": place.devices.radius_m,
        "vehicles": place.demand.vehicles,
        "seeds": place.simulation.seeds,
        "loaded": found.loaded.tolist(),
        "unfinished": found.unfinished.tolist(),
        "teleports": found.teleports.tolist(),
        "cut_off": routes.cut_off,
        "warnings": found.warnings(),
        "sumo": sumo.version(),
        "network_sha256": network.sha256,
        "command": command,
        "settings": place.model_dump(mode="json"),
    }
    return Evacuation(
        meta=meta,
        position=position.astype(np.float32),
        density=each.mean(axis=0).astype(np.float32),
        density_spread=each.std(axis=0, ddof=min(1, len(each) - 1)).astype(np.float32),
        weight=scaled(each.mean(axis=0)),
        window_weight=scaled(near.mean(axis=0)),
        road_shape=np.concatenate(network.shapes).astype(np.float32),
        road_corners=np.array([len(shape) for shape in network.shapes], np.int32),
        road_lanes=network.lanes.astype(np.int32),
        road_density=found.density.mean(axis=0).astype(np.float32),
    )

"""Build an evacuation: network, demand, simulations, devices, weights."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from uavmec_jax.traffic import sumo
from uavmec_jax.traffic.demand import Routes, find_routes
from uavmec_jax.traffic.devices import check_devices, place_devices
from uavmec_jax.traffic.evacuation import Evacuation
from uavmec_jax.traffic.network import RoadNetwork, build_network
from uavmec_jax.traffic.place import Place
from uavmec_jax.traffic.simulation import Densities, simulate
from uavmec_jax.traffic.weights import density_near, divide_by_maximum
from uavmec_jax.traffic.workspace import Workspace


def build_evacuation(
    place: Place, folder: Path, *, command: str = "", on_progress: Callable[[str], None] = lambda _: None
) -> Evacuation:
    """Simulate the evacuation of a place and measure the traffic density near its devices.

    Args:
        place: from :func:`uavmec_jax.traffic.place.load_place`.
        folder: the place's paths are relative to it.
        command: the command line, recorded in the result.
        on_progress: called with a line of text after each stage.

    Raises:
        TrafficError: a file is not usable, SUMO is missing or fails, or the place is inconsistent; one line.
    """
    with Workspace() as workspace:
        network = build_network(place.network, folder, workspace)
        on_progress(f"network: {len(network.roads):,} roads, {len(network.junctions):,} junctions")
        routes = find_routes(network, place.demand, place.name)
        check_devices(place, network, routes)
        on_progress(
            f"demand: {len(routes.origins):,} origins, {len(routes.exits)} exits, {place.demand.vehicles:,} vehicles"
        )
        densities = simulate(
            network,
            routes,
            place.demand,
            place.simulation,
            workspace,
            lambda done: on_progress(f"simulation {done} of {place.simulation.seeds}"),
        )
    first, last = place.simulation.windows
    names, position = place_devices(place, network, routes, densities.density[:, first:last].mean(axis=(0, 1)))
    near = density_near(position, network.shapes, network.lanes, densities.density, place.devices.radius_m)  # [S, W, n]
    per_seed = near[:, first:last].mean(axis=1)
    return Evacuation(
        meta=_metadata(place, names, network, routes, densities, command),
        position=position.astype(np.float32),
        density=per_seed.mean(axis=0).astype(np.float32),
        density_spread=per_seed.std(axis=0, ddof=min(1, len(per_seed) - 1)).astype(np.float32),
        weight=divide_by_maximum(per_seed.mean(axis=0)),
        window_weight=divide_by_maximum(near.mean(axis=0)),
        road_shape=np.concatenate(network.shapes).astype(np.float32),
        road_corners=np.array([len(shape) for shape in network.shapes], np.int32),
        road_lanes=network.lanes.astype(np.int32),
        road_density=densities.density.mean(axis=0).astype(np.float32),
    )


def _metadata(
    place: Place, names: list[str], network: RoadNetwork, routes: Routes, densities: Densities, command: str
) -> dict[str, Any]:
    """Return how an evacuation was made, as :class:`Evacuation` holds it."""
    first, last = place.simulation.windows
    return {
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
        "loaded": densities.loaded.tolist(),
        "unfinished": densities.unfinished.tolist(),
        "teleports": densities.teleports.tolist(),
        "cut_off": routes.cut_off,
        "warnings": densities.warnings(),
        "sumo": sumo.version(),
        "network_sha256": network.sha256,
        "command": command,
        "settings": place.model_dump(mode="json"),
    }

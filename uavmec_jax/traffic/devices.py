"""Where devices stand: as a file says, or at junctions far from each other, a share of them on the corridors."""

import numpy as np

from uavmec_jax.errors import TrafficError
from uavmec_jax.traffic.demand import Routes
from uavmec_jax.traffic.network import RoadNetwork
from uavmec_jax.traffic.place import Place, Placement, Site
from uavmec_jax.traffic.weights import density_near
from uavmec_jax.world.settings import nearest

_CORRIDOR_QUANTILE = 0.8


def place_devices(
    place: Place, network: RoadNetwork, routes: Routes, density: np.ndarray
) -> tuple[list[str], np.ndarray]:
    """Names, and positions ``[n, 2]`` m in the network.

    Args:
        place: its sites, or how to choose them.
        network: the junctions.
        routes: the devices are placed around the middle of the origins.
        density: ``[R]`` vehicles per km and lane, which say what a corridor is.

    Raises:
        TrafficError: a junction does not exist, or there are fewer of them than devices.
    """
    if place.device:
        return [site.name for site in place.device], np.array([_of(site, network, place.name) for site in place.device])
    chosen = _chosen(place.name, place.devices, network, _middle(routes), density)
    return _named(chosen, network), np.array([network.junctions[junction] for junction in chosen])


def _named(junctions: list[str], network: RoadNetwork) -> list[str]:
    """A name for each junction: the streets that meet there, with its id where two have the same; or the id."""
    streets = [" and ".join(network.streets_at(junction)[:2]) or junction for junction in junctions]
    twice = {name for name in streets if streets.count(name) > 1}
    return [f"{name} ({own})" if name in twice else name for name, own in zip(streets, junctions, strict=True)]


def _of(site: Site, network: RoadNetwork, name: str) -> tuple[float, float]:
    if site.junction is None:
        assert site.x_m is not None
        assert site.y_m is not None
        return site.x_m, site.y_m
    if site.junction not in network.junctions:
        hint = nearest(site.junction, network.junctions)
        raise TrafficError(f"{name}: device {site.name!r}: junction is {site.junction!r}, which does not exist; {hint}")
    return network.junctions[site.junction]


def _middle(routes: Routes) -> np.ndarray:
    """Where people live, on average."""
    middles = np.array([road.shape.mean(axis=0) for road in routes.origins])
    return np.asarray(routes.origin_share @ middles)


def _chosen(
    name: str, placement: Placement, network: RoadNetwork, middle: np.ndarray, density: np.ndarray
) -> list[str]:
    ids = list(network.junctions)
    position = np.array([network.junctions[junction] for junction in ids])
    inside = np.flatnonzero(np.abs(position - middle).max(axis=1) <= placement.span_m / 2)
    if len(inside) < placement.count:
        raise TrafficError(
            f"{name}: {placement.count} devices, but {len(inside)} junctions in the {placement.span_m:g} m around where "
            f"people live ({len(ids)} in all); give fewer devices.count or a larger devices.span_m"
        )
    roads = list(network.roads.values())
    near = density_near(
        position[inside],
        [road.shape for road in roads],
        np.array([road.lanes for road in roads], float),
        density,
        placement.radius_m,
    )
    dense = inside[near >= np.quantile(near, _CORRIDOR_QUANTILE)]
    calm = inside[near <= np.median(near)]
    on_corridors = min(round(placement.corridor_share * placement.count), len(dense))
    taken = farthest_points(position, dense, on_corridors, [])
    taken = farthest_points(position, np.setdiff1d(calm, taken), placement.count - on_corridors, taken)
    if len(taken) < placement.count:
        rest = np.setdiff1d(inside, taken)
        taken = farthest_points(position, rest, placement.count - len(taken), taken)
    return [ids[k] for k in taken]


def farthest_points(position: np.ndarray, candidates: np.ndarray, count: int, taken: list[int]) -> list[int]:
    """Add ``count`` candidates (or all), each as far as can be from those taken; the first one from their middle.

    Args:
        position: ``[J, 2]`` m.
        candidates: indices into it.
        count: how many to add.
        taken: indices that are taken already.
    """
    taken = list(taken)
    for _ in range(min(count, len(candidates))):
        away = position[candidates][:, None] - (position[taken] if taken else position[candidates].mean(axis=0))[None]
        distance = np.linalg.norm(away.reshape(len(candidates), -1, 2), axis=-1).min(axis=1)
        taken.append(int(candidates[np.argmax(distance)]))
        candidates = candidates[candidates != taken[-1]]
    return taken

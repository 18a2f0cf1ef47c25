"""Where devices stand: as a file says, or at junctions far from each other, a share of them on the corridors."""

import numpy as np

from uavmec_jax.errors import TrafficError
from uavmec_jax.files.validation import suggest
from uavmec_jax.traffic.demand import Routes
from uavmec_jax.traffic.network import RoadNetwork
from uavmec_jax.traffic.place import Place, Placement, Site
from uavmec_jax.traffic.weights import density_near

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
        TrafficError: see :func:`check_devices`.
    """
    if place.device:
        return [site.name for site in place.device], np.array([_of(site, network, place.name) for site in place.device])
    chosen = _chosen(place.devices, network, _inside(place, network, routes), density)
    return _named(chosen, network), np.array([network.junctions[junction] for junction in chosen])


def check_devices(place: Place, network: RoadNetwork, routes: Routes) -> None:
    """Refuse before anything is simulated what :func:`place_devices` could not do.

    Raises:
        TrafficError: a junction does not exist, or there are fewer of them than devices.
    """
    if not place.device:
        _inside(place, network, routes)
    for site in place.device:
        _of(site, network, place.name)


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
        hint = suggest(site.junction, network.junctions)
        raise TrafficError(f"{name}: device {site.name!r}: junction is {site.junction!r}, which does not exist; {hint}")
    return network.junctions[site.junction]


def _inside(place: Place, network: RoadNetwork, routes: Routes) -> np.ndarray:
    """Junctions, by their place in the network, within ``span_m`` around where people live on average."""
    middle = routes.origin_share @ np.array([road.shape.mean(axis=0) for road in routes.origins])
    position = np.array(list(network.junctions.values()))
    count, span = place.devices.count, place.devices.span_m
    inside = np.flatnonzero(np.abs(position - middle).max(axis=1) <= span / 2)
    if len(inside) < count:
        raise TrafficError(
            f"{place.name}: {count} devices, but {len(inside)} junctions in the {span:g} m around where people live "
            f"({len(position)} in all); give fewer devices.count or a larger devices.span_m"
        )
    return inside


def _chosen(placement: Placement, network: RoadNetwork, inside: np.ndarray, density: np.ndarray) -> list[str]:
    ids, position = list(network.junctions), np.array(list(network.junctions.values()))
    near = density_near(position[inside], network.shapes, network.lanes, density, placement.radius_m)
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

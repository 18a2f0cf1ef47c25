"""Place devices: where a file says, or at junctions far apart from each other, a share of them on busy corridors."""

import numpy as np
from jaxtyping import Float, Int

from uavmec_jax.errors import TrafficError
from uavmec_jax.files.validation import suggest
from uavmec_jax.traffic.demand import Routes
from uavmec_jax.traffic.network import RoadNetwork
from uavmec_jax.traffic.place import Place, Placement
from uavmec_jax.traffic.sites import site_label
from uavmec_jax.traffic.weights import density_near

_CORRIDOR_QUANTILE = 0.8
"""Junctions whose traffic density is at or above this quantile lie on a corridor."""

_MAX_NAME, _SHORT_NAME = 80, 60
"""Longest name of a device, and what is left of a longer one before its number."""


def place_devices(
    place: Place, network: RoadNetwork, routes: Routes, density: Float[np.ndarray, " R"]
) -> tuple[list[str], Float[np.ndarray, "n 2"]]:
    """Place the devices.

    Args:
        place: its sites, or how to choose them.
        network: the junctions.
        routes: the devices are placed around the centre of the origins.
        density: ``[R]`` vehicles per km and lane, which tell corridors from other roads.

    Returns:
        Names, and positions ``[n, 2]`` m in the network.

    Raises:
        TrafficError: see :func:`check_devices`.
    """
    if place.device:
        positions = _site_positions(place, network)
        return [site.name for site in place.device], np.array(positions, float)
    chosen = _choose_junctions(place.devices, network, _nearby_junctions(place, network, routes), density)
    return _junction_names(chosen, network), np.array([network.junctions[junction] for junction in chosen], float)


def check_devices(place: Place, network: RoadNetwork, routes: Routes) -> None:
    """Check, before anything is simulated, that :func:`place_devices` can place the devices.

    Raises:
        TrafficError: a junction does not exist, or there are fewer junctions than devices.
    """
    if not place.device:
        _nearby_junctions(place, network, routes)
    _site_positions(place, network)


def _junction_names(junctions: list[str], network: RoadNetwork) -> list[str]:
    """Name each junction by the streets that meet there, with its id where two names are equal; or by its id.

    Names differ, can be printed, and are as long as those of devices may be.
    """
    streets = [_one_line(" and ".join(network.streets_at(junction)[:2])) or junction for junction in junctions]
    repeated = {name for name in streets if streets.count(name) > 1}
    names: list[str] = []
    for number, (street, id_) in enumerate(zip(streets, junctions, strict=True), 1):
        name = f"{street} ({id_})" if street in repeated else street
        if len(name) > _MAX_NAME or name in names:
            name = f"{street[:_SHORT_NAME]} ({number})"
        names.append(name)
    return names


def _one_line(name: str) -> str:
    """Return a name from a map without what cannot be printed."""
    return "".join(letter for letter in " ".join(name.split()) if letter.isprintable())


def _site_positions(place: Place, network: RoadNetwork) -> list[tuple[float, float]]:
    """Return the positions of a place's sites in metres."""
    positions = []
    for number, site in enumerate(place.device, 1):
        if site.junction is None:
            assert site.x_m is not None
            assert site.y_m is not None
            positions.append((site.x_m, site.y_m))
        elif site.junction in network.junctions:
            positions.append(network.junctions[site.junction])
        else:
            hint = suggest(site.junction, network.junctions)
            label = site_label(number, site.name)
            raise TrafficError(f"{place.name}: {label}: junction is {site.junction!r}, which does not exist; {hint}")
    return positions


def _nearby_junctions(place: Place, network: RoadNetwork, routes: Routes) -> Int[np.ndarray, " J"]:
    """Return the indices of the junctions in a square of side ``span_m`` around the mean position of the origins."""
    centre = routes.origin_share @ np.array([road.shape.mean(axis=0) for road in routes.origins])
    position = np.array(list(network.junctions.values()))
    count, span = place.devices.count, place.devices.span_m
    nearby = np.flatnonzero(np.abs(position - centre).max(axis=1) <= span / 2)
    if len(nearby) < count:
        raise TrafficError(
            f"{place.name}: {count} devices, but {len(nearby)} junctions in the {span:g} m around where people live "
            f"({len(position)} in all); give fewer devices.count or a larger devices.span_m"
        )
    return nearby


def _choose_junctions(
    placement: Placement, network: RoadNetwork, nearby: Int[np.ndarray, " J"], density: Float[np.ndarray, " R"]
) -> list[str]:
    """Choose junctions: some on the corridors, the others among those with less than median traffic."""
    ids, position = list(network.junctions), np.array(list(network.junctions.values()), float)
    near = density_near(position[nearby], network.shapes, network.lanes, density, placement.radius_m)
    corridors = nearby[near >= np.quantile(near, _CORRIDOR_QUANTILE)]
    calm = nearby[near <= np.median(near)]
    on_corridors = min(round(placement.corridor_share * placement.count), len(corridors))
    taken = farthest_points(position, corridors, on_corridors, [])
    taken = farthest_points(position, np.setdiff1d(calm, taken), placement.count - on_corridors, taken)
    if len(taken) < placement.count:
        rest = np.setdiff1d(nearby, taken)
        taken = farthest_points(position, rest, placement.count - len(taken), taken)
    return [ids[k] for k in taken]


def farthest_points(
    position: Float[np.ndarray, "J 2"], candidates: Int[np.ndarray, " C"], count: int, taken: list[int]
) -> list[int]:
    """Add candidates one by one, each as far as possible from those taken; the first one from the candidates' mean.

    Args:
        position: ``[J, 2]`` m.
        candidates: indices into ``position``.
        count: number of candidates to add; all, if there are fewer.
        taken: indices taken already.

    Returns:
        ``taken``, followed by the added indices.
    """
    taken = list(taken)
    for _ in range(min(count, len(candidates))):
        away = position[candidates][:, None] - (position[taken] if taken else position[candidates].mean(axis=0))[None]
        distance = np.linalg.norm(away.reshape(len(candidates), -1, 2), axis=-1).min(axis=1)
        taken.append(int(candidates[np.argmax(distance)]))
        candidates = candidates[candidates != taken[-1]]
    return taken

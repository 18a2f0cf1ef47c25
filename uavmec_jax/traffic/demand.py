"""AgentIds drives where and when: Rayleigh loading of an evacuation, and through traffic."""

from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from uavmec_jax.errors import TrafficError
from uavmec_jax.files.validation import suggest
from uavmec_jax.traffic.network import HIGHWAYS, RESIDENTIAL, Road, RoadNetwork
from uavmec_jax.traffic.place import Demand


@dataclass(frozen=True)
class Routes:
    """Origins and exits of an evacuation, with their weights, and who can reach what.

    Attributes:
        origins: roads where people live, ``[O]``.
        origin_share: ``[O]`` share of the vehicles.
        exits: roads on which they leave, ``[E]``.
        exit_share: ``[O, E]`` share of an origin's vehicles; 0 where there is no way.
        entries: roads on which through traffic arrives, ``[T]``.
        through_share: ``[T, E]`` share of all through traffic.
        cut_off: residential roads without a way to any exit, which were left out.
    """

    origins: list[Road]
    origin_share: np.ndarray
    exits: list[Road]
    exit_share: np.ndarray
    entries: list[Road]
    through_share: np.ndarray
    cut_off: int


def find_routes(network: RoadNetwork, demand: Demand, name: str) -> Routes:
    """Origins and exits, as given or by road class.

    Raises:
        TrafficError: there are none, one that is given does not exist, or no exit can be reached; one line.
    """
    exits, weights = _exits(network, demand, name)
    reached_from = [network.leading_to(road.id) for road in exits]
    origins = _origins(network, demand, name, {road.id for road in exits})
    reach = np.array([[road.id in reached for reached in reached_from] for road in origins], float)
    connected = np.asarray(reach.any(axis=1))
    if demand.origins and not connected.all():
        road = origins[int(np.argmin(connected))]
        raise TrafficError(f"{name}: demand.origins has {road.id!r}, from which no way leads to any exit")
    if not connected.any():
        raise TrafficError(
            f"{name}: none of its {len(origins)} residential roads has a way to any exit; give demand.exits"
        )
    open_roads = [road for road, can in zip(origins, connected, strict=True) if can]
    lengths = np.array([road.length_m for road in open_roads])
    shares = reach[connected] * weights
    entries = [road for road in network.of_kind(HIGHWAYS) if network.is_beginning(road)]
    return Routes(
        origins=open_roads,
        origin_share=lengths / lengths.sum(),
        exits=exits,
        exit_share=shares / shares.sum(axis=1, keepdims=True),
        entries=entries,
        through_share=_through(entries, exits, reached_from),
        cut_off=int((~connected).sum()),
    )


def _through(entries: list[Road], exits: list[Road], reached_from: list[set[str]]) -> np.ndarray:
    """``[T, E]`` shares of the through traffic: between ends of highways of one class that do not lie side by side."""
    if not entries:
        return np.zeros((0, len(exits)))
    start = np.array([road.shape[0] for road in entries])
    metres = np.linalg.norm(start[:, None] - np.array([road.shape[-1] for road in exits]), axis=-1)
    far = (metres > 0) & (metres >= metres.max() / 4)  # coming back on the other carriageway is no through traffic
    fits = [
        [entry.kind == end.kind and entry.id in near for near, end in zip(reached_from, exits, strict=True)]
        for entry in entries
    ]
    lanes = np.outer([road.lanes for road in entries], [road.lanes for road in exits])
    share = far * np.array(fits) * lanes
    return share / max(share.sum(), 1.0)


def _exits(network: RoadNetwork, demand: Demand, name: str) -> tuple[list[Road], np.ndarray]:
    if not demand.exits:
        ends = [road for road in network.of_kind(HIGHWAYS) if network.is_end(road)]
        if not ends:
            raise TrafficError(
                f"{name}: has no highway exit (no {', '.join(HIGHWAYS)} ends in it); give demand.exits (--exit)"
            )
        return ends, np.array([road.lanes * road.speed_m_s for road in ends])
    found = []
    for given in demand.exits:
        into = [network.roads[given]] if given in network.roads else network.into(given)
        if not into:
            hint = suggest(given, network.junctions)
            raise TrafficError(f"{name}: demand.exits has {given!r}, which is neither a road nor a junction; {hint}")
        found.append(into[0])
    return found, np.array(list(demand.exits.values()), float)


def _origins(network: RoadNetwork, demand: Demand, name: str, exits: set[str]) -> list[Road]:
    for given in demand.origins:
        if given not in network.roads:
            raise TrafficError(
                f"{name}: demand.origins has {given!r}, which is not a road; {suggest(given, network.roads)}"
            )
    if demand.origins:
        return [network.roads[given] for given in demand.origins]
    for kind in RESIDENTIAL:
        roads = [road for road in network.of_kind([kind]) if road.id not in exits]
        if roads:
            return roads
    raise TrafficError(f"{name}: has no residential roads to leave from; give demand.origins (--origin)")


def departures(demand: Demand, duration_s: float, rng: np.random.Generator) -> np.ndarray:
    """Seconds ``[<= vehicles]`` after the order at which vehicles leave, within the evacuation, sorted (Rayleigh)."""
    times = np.sort(rng.rayleigh(demand.loading_sigma_s, demand.vehicles))
    return times[times < duration_s]


def write_trips(path: Path, routes: Routes, demand: Demand, duration_s: float, seed: int) -> int:
    """Write the trips of one simulation in order of departure; how many there are.

    Times in the file start with the through traffic's warm-up, ``demand.warm_up_s`` before the order.
    """
    rng = np.random.default_rng(seed)
    leave = departures(demand, duration_s, rng) + demand.warm_up_s
    origin = rng.choice(len(routes.origins), leave.size, p=routes.origin_share)
    chosen = (routes.exit_share[origin].cumsum(axis=1) > rng.random((leave.size, 1))).argmax(axis=1)
    trips = [
        (time, routes.origins[o].id, routes.exits[e].id, "r") for time, o, e in zip(leave, origin, chosen, strict=True)
    ]
    if routes.through_share.any():
        atomic = demand.warm_up_s + duration_s
        times = rng.uniform(0, atomic, rng.poisson(demand.through_per_hour * atomic / 3600))
        pairs = rng.choice(routes.through_share.size, times.size, p=routes.through_share.ravel())
        for time, pair in zip(times, pairs, strict=True):
            t, e = divmod(int(pair), len(routes.exits))
            trips.append((time, routes.entries[t].id, routes.exits[e].id, "t"))
    trips.sort()
    with path.open("w", encoding="utf-8") as file:
        file.write("<routes>\n")
        for number, (time, start, end, kind) in enumerate(trips):
            ends = f"from={quoteattr(start)} to={quoteattr(end)}"
            speed = "max" if kind == "t" else "0"
            file.write(
                f'<trip id="{kind}{number}" depart="{time:.2f}" departLane="best" departSpeed="{speed}" {ends}/>\n'
            )
        file.write("</routes>\n")
    return len(trips)

"""Travel demand: Rayleigh loading of an evacuation, and through traffic."""

from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Float

from uavmec_jax.errors import TrafficError
from uavmec_jax.files.validation import suggest
from uavmec_jax.traffic.network import HIGHWAYS, RESIDENTIAL, Road, RoadNetwork
from uavmec_jax.traffic.place import Demand


@dataclass(frozen=True)
class Routes:
    """Origins and exits of an evacuation, and the shares of the vehicles that drive between them.

    Attributes:
        origins: ``O`` roads where people live.
        origin_share: ``[O]`` share of the vehicles that start on each origin.
        exits: ``E`` roads on which vehicles leave.
        exit_share: ``[O, E]`` share of an origin's vehicles that leave by each exit; 0 where there is no way.
        entries: ``T`` roads on which through traffic arrives.
        through_share: ``[T, E]`` share of all through traffic.
        cut_off: number of residential roads that are left out because no exit can be reached from them.
    """

    origins: list[Road]
    origin_share: Float[np.ndarray, " O"]
    exits: list[Road]
    exit_share: Float[np.ndarray, "O E"]
    entries: list[Road]
    through_share: Float[np.ndarray, "T E"]
    cut_off: int


def find_routes(network: RoadNetwork, demand: Demand, name: str) -> Routes:
    """Find origins and exits: those that the demand names, or roads of the classes that fit.

    Args:
        network: the roads.
        demand: its origins and exits, if it names any.
        name: of the place, for error messages.

    Raises:
        TrafficError: there are none, one that is given does not exist, or no exit can be reached; one line.
    """
    exits, weights = _find_exits(network, demand, name)
    reaching = [network.roads_reaching(road.id) for road in exits]
    origins = _find_origins(network, demand, name, {road.id for road in exits})
    reachable = np.array([[road.id in roads for roads in reaching] for road in origins], float)
    connected = np.asarray(reachable.any(axis=1))
    if demand.origins and not connected.all():
        road = origins[int(np.argmin(connected))]
        raise TrafficError(f"{name}: demand.origins has {road.id!r}, from which no way leads to any exit")
    if not connected.any():
        raise TrafficError(
            f"{name}: none of its {len(origins)} residential roads has a way to any exit; give demand.exits"
        )
    open_roads = [road for road, is_connected in zip(origins, connected, strict=True) if is_connected]
    lengths = np.array([road.length_m for road in open_roads])
    shares = reachable[connected] * weights
    entries = [road for road in network.of_class(HIGHWAYS) if network.is_source(road)]
    return Routes(
        origins=open_roads,
        origin_share=lengths / lengths.sum(),
        exits=exits,
        exit_share=shares / shares.sum(axis=1, keepdims=True),
        entries=entries,
        through_share=_through_share(entries, exits, reaching),
        cut_off=int((~connected).sum()),
    )


def _through_share(entries: list[Road], exits: list[Road], reaching: list[set[str]]) -> Float[np.ndarray, "T E"]:
    """Share the through traffic among pairs of highway ends of one class that do not lie side by side."""
    if not entries:
        return np.zeros((0, len(exits)))
    start = np.array([road.shape[0] for road in entries])
    metres = np.linalg.norm(start[:, None] - np.array([road.shape[-1] for road in exits]), axis=-1)
    far = (metres > 0) & (metres >= metres.max() / 4)  # returning on the other carriageway is no through traffic
    joined = [
        [entry.road_class == end.road_class and entry.id in roads for roads, end in zip(reaching, exits, strict=True)]
        for entry in entries
    ]
    lanes = np.outer([road.lanes for road in entries], [road.lanes for road in exits])
    share = far * np.array(joined) * lanes
    return share / max(share.sum(), 1.0)


def _find_exits(network: RoadNetwork, demand: Demand, name: str) -> tuple[list[Road], Float[np.ndarray, " E"]]:
    """Find the exits and their weights."""
    if not demand.exits:
        ends = [road for road in network.of_class(HIGHWAYS) if network.is_sink(road)]
        if not ends:
            raise TrafficError(
                f"{name}: has no highway exit (no {', '.join(HIGHWAYS)} ends in it); give demand.exits (--exit)"
            )
        return ends, np.array([road.lanes * road.speed_m_s for road in ends])
    exits = []
    for given in demand.exits:
        incoming = [network.roads[given]] if given in network.roads else network.roads_into(given)
        if not incoming:
            hint = suggest(given, network.junctions)
            raise TrafficError(f"{name}: demand.exits has {given!r}, which is neither a road nor a junction; {hint}")
        exits.append(incoming[0])
    return exits, np.array(list(demand.exits.values()), float)


def _find_origins(network: RoadNetwork, demand: Demand, name: str, exits: set[str]) -> list[Road]:
    for given in demand.origins:
        if given not in network.roads:
            raise TrafficError(
                f"{name}: demand.origins has {given!r}, which is not a road; {suggest(given, network.roads)}"
            )
    if demand.origins:
        return [network.roads[given] for given in demand.origins]
    for road_class in RESIDENTIAL:
        roads = [road for road in network.of_class([road_class]) if road.id not in exits]
        if roads:
            return roads
    raise TrafficError(f"{name}: has no residential roads to leave from; give demand.origins (--origin)")


def departures(demand: Demand, duration_s: float, rng: np.random.Generator) -> Float[np.ndarray, " V"]:
    """Draw departure times, s after the order to leave: sorted, Rayleigh distributed, those within the evacuation."""
    times = np.sort(rng.rayleigh(demand.loading_sigma_s, demand.vehicles))
    return times[times < duration_s]


def write_trips(path: Path, routes: Routes, demand: Demand, duration_s: float, seed: int) -> int:
    """Write the trips of one simulation in order of departure, and return their number.

    Times in the file start with the warm-up of through traffic, ``demand.warm_up_s`` before the order to leave.
    """
    rng = np.random.default_rng(seed)
    times = departures(demand, duration_s, rng) + demand.warm_up_s
    origin = rng.choice(len(routes.origins), times.size, p=routes.origin_share)
    exit_ = (routes.exit_share[origin].cumsum(axis=1) > rng.random((times.size, 1))).argmax(axis=1)
    # Trips are named by who makes them, "r" for residents and "t" for through traffic, and a number.
    trips = [
        (time, routes.origins[o].id, routes.exits[e].id, "r") for time, o, e in zip(times, origin, exit_, strict=True)
    ]
    if routes.through_share.any():
        total_s = demand.warm_up_s + duration_s
        times = rng.uniform(0, total_s, rng.poisson(demand.through_per_hour * total_s / 3600))
        pairs = rng.choice(routes.through_share.size, times.size, p=routes.through_share.ravel())
        for time, pair in zip(times, pairs, strict=True):
            t, e = divmod(int(pair), len(routes.exits))
            trips.append((time, routes.entries[t].id, routes.exits[e].id, "t"))
    trips.sort()
    lines = ["<routes>\n"]
    for number, (time, start, end, kind) in enumerate(trips):
        ends = f"from={quoteattr(start)} to={quoteattr(end)}"
        speed = "max" if kind == "t" else "0"
        lines.append(
            f'<trip id="{kind}{number}" depart="{time:.2f}" departLane="best" departSpeed="{speed}" {ends}/>\n'
        )
    path.write_text("".join([*lines, "</routes>\n"]), encoding="utf-8")
    return len(trips)

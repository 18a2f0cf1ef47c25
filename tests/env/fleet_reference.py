"""One slot of a fleet in plain NumPy, one UAV, device and depot after the other, in double precision.

It is written from the rules and shares nothing with the package but the names of the fields, so the two can be held
against each other. States and outcomes are dictionaries named like the package's fields. An outcome also holds what devices
drained and UAVs paid, J, and its ``edge``: how close the nearest comparison came to going the other way, relative to the
numbers compared. Below about 1e-5, single precision may decide otherwise.
"""

import math
from dataclasses import dataclass

import numpy as np

NONE, BATTERY, DATA_AGE, UAV, HORIZON, SHARE = range(6)
SWAP, CHARGE = range(2)


@dataclass
class Vehicle:
    """A UAV: what it can do, and where the slot finds it."""

    speed: float
    flying: float
    hovering: float
    capacity: float
    reach: float
    position: np.ndarray
    energy: float
    grounded: bool


@dataclass
class Station:
    """A depot, with the packs it has left."""

    position: np.ndarray
    kind: float
    pads: float
    packs: float
    power: float

    def helps(self):
        """Return whether a UAV may still get energy here."""
        return self.pads >= 1 and (self.packs >= 1 if self.kind == SWAP else self.power > 0)


@dataclass
class Plan:
    """What a slot would be with a given set of UAVs in the air."""

    uploader: list  # per device: the UAV that serves it, or None
    upload: list  # per device: seconds of its upload
    compute: list  # per device: seconds of its own work
    report: list  # per device: seconds in which it sends its results
    duration: float
    cost: dict  # per UAV of the set: J


class Edge:
    """The closest call among the comparisons of a slot."""

    def __init__(self):
        self.nearest = math.inf

    def at_least(self, left, right):
        """Return ``left >= right``, and remember how close that was; what costs nothing is no close call."""
        if right != 0 and math.isfinite(right):
            self.nearest = min(self.nearest, abs(left - right) / max(abs(left), abs(right)))
        return left >= right


def array(value):
    """Return a leaf as doubles."""
    return np.asarray(value, np.float64)


def read_vehicles(params, layout, state):
    """Return the UAVs as the slot finds them."""
    positions = array(state.uav_position).reshape(-1, 2)
    energies = array(state.uav_energy).reshape(-1)
    fleet = layout.fleet
    vehicles = []
    for v, (position, energy) in enumerate(zip(positions, energies, strict=True)):
        fields = ("speed_m_s", "flying_power_w", "hovering_power_w", "battery_j", "signal_range_m")
        constants = [getattr(params, f"uav_{name}") if fleet is None else getattr(fleet, name)[v] for name in fields]
        padding = fleet is not None and fleet.present is not None and not fleet.present[v]
        grounded = padding or (state.grounded is not None and bool(np.asarray(state.grounded).reshape(-1)[v]))
        vehicles.append(Vehicle(*map(float, constants), position, energy, grounded))
    return vehicles


def read_stations(layout, state):
    """Return the depots as the slot finds them."""
    depots = layout.depots
    if depots is None:
        return []
    left = depots.packs if state.packs is None else state.packs
    rows = zip(array(depots.position), depots.kind, depots.pads, left, depots.power_w, strict=True)
    return [Station(position, *map(float, numbers)) for position, *numbers in rows]


def present_devices(layout):
    """Return the numbers of the devices that are no padding."""
    return [d for d in range(len(layout.capacity)) if layout.present is None or layout.present[d]]


def living_devices(layout, state):
    """Return the numbers of the devices whose batteries have not run out in this state."""
    return [d for d in present_devices(layout) if state.failed_at is None or state.failed_at[d] < 0]


def chosen_places(layout, action, stations):
    """Return each UAV's place, the nearest number that exists."""
    last = len(layout.capacity) + len(stations) - 1
    return [min(max(int(place), 0), last) for place in np.asarray(action).reshape(-1)]


def expiry(params):
    """Return the age at which data have expired."""
    return int(params.data_age_limit_slots) + (0 if params.age_at_limit_fails else 1)


def station_at(stations, position):
    """Return the number of the depot at exactly this point, the lowest if there are several, or None."""
    for number, station in enumerate(stations):
        if station.position[0] == position[0] and station.position[1] == position[1]:
            return number
    return None


def upload_seconds(params, slant, volume):
    """Return how long an upload over this distance takes, alone in the whole band."""
    gain = 10.0 ** (float(params.reference_gain_db_at_1m) / 10.0) * slant ** -float(params.path_loss_exponent)
    noise = 10.0 ** ((float(params.noise_power_dbm) - 30.0) / 10.0)
    rate = float(params.bandwidth_hz) * math.log2(1.0 + float(params.transmit_power_w) * gain / noise)
    return 8.0 * volume / rate


def plan_slot(params, layout, vehicles, places, spots, flights, flying, living, volumes, edge):
    """Work out a slot in which the UAVs ``flying`` take part."""
    n = len(layout.capacity)
    plan = Plan([None] * n, [0.0] * n, [0.0] * n, [0.0] * n, 0.0, {})
    for d in living:
        through = math.inf
        for v in flying:
            if places[v] >= n:
                continue  # it lands
            ground = math.dist(spots[v], array(layout.position[d]))
            slant = math.hypot(ground, float(params.uav_altitude_m))
            if places[v] != d and not edge.at_least(vehicles[v].reach, slant):
                continue
            upload = upload_seconds(params, slant, float(volumes[d]))
            if plan.uploader[d] is not None and upload != plan.upload[d]:
                edge.at_least(flights[v] + upload, through)
            if flights[v] + upload < through:
                through, plan.uploader[d], plan.upload[d] = flights[v] + upload, v, upload
        if plan.uploader[d] is None:
            plan.compute[d] = min(float(volumes[d]) / float(layout.processing_rate[d]), float(params.slot_cap_s))
            if layout.has_comms[d]:
                plan.report[d] = 8.0 * float(params.result_message_bytes) / float(params.uplink_rate_bit_s)
            through = plan.compute[d] + plan.report[d]
        plan.duration = max(plan.duration, through)
    if not living:
        plan.duration = float(params.slot_cap_s)
    for v in flying:
        plan.duration = max(plan.duration, flights[v])
    for v in flying:
        plan.cost[v] = vehicles[v].flying * flights[v]
        if places[v] < n:
            hovers = plan.duration if params.flight_power_adds_to_hover else plan.duration - flights[v]
            plan.cost[v] += vehicles[v].hovering * hovers
    return plan


def serve_at_depots(vehicles, stations, guests, energy, duration):
    """Swap and charge; ``guests`` are the landed UAVs: their number -> (depot, seconds of flight in this slot)."""
    for number, station in enumerate(stations):
        free = station.pads
        for v in sorted(guests):
            depot, flight = guests[v]
            if depot != number or energy[v] >= vehicles[v].capacity or free < 1:
                continue
            free -= 1
            if station.kind == CHARGE:
                energy[v] = min(energy[v] + station.power * max(duration - flight, 0.0), vehicles[v].capacity)
            elif station.packs >= 1:
                station.packs -= 1
                energy[v] = vehicles[v].capacity


def reference_slot(params, layout, state, action, volumes):
    """Return the state after one slot and its outcome, as dictionaries."""
    n = len(layout.capacity)
    edge = Edge()
    vehicles, stations = read_vehicles(params, layout, state), read_stations(layout, state)
    living = living_devices(layout, state)
    places = chosen_places(layout, action, stations)
    spots = [array(layout.position[p]) if p < n else stations[p - n].position for p in places]
    flights = [math.dist(one.position, spot) / one.speed for one, spot in zip(vehicles, spots, strict=True)]
    willing = [v for v, one in enumerate(vehicles) if not one.grounded]

    # Which UAVs start: first their own flights, then the whole slot, until all that are left can pay.
    flying = [v for v in willing if edge.at_least(vehicles[v].energy, vehicles[v].flying * flights[v])]
    while True:
        plan = plan_slot(params, layout, vehicles, places, spots, flights, flying, living, volumes, edge)
        able = [v for v in flying if edge.at_least(vehicles[v].energy, plan.cost[v])]
        if able == flying:
            break
        flying = able

    after = {
        "battery": array(state.battery).copy(),
        "age": np.array(state.age, int),
        "uav_position": np.array([one.position for one in vehicles]),
        "uav_energy": np.array([one.energy for one in vehicles]),
        "slot": int(state.slot),
        "elapsed": float(state.elapsed),
        "grounded": np.array([one.grounded for one in vehicles]),
        "failed_at": np.full(n, -1) if state.failed_at is None else np.array(state.failed_at, int),
        "packs": np.array([station.packs for station in stations]),
    }
    outcome = {
        "cause": NONE,
        "failed": np.zeros(n, bool),
        "served": np.zeros(n, bool),
        "duration": 0.0,
        "first_failure": np.zeros(n),
        "started": np.array([v in flying for v in range(len(vehicles))]),
        "drain": np.zeros(n),
        "paid": np.zeros(len(vehicles)),
        "edge": edge.nearest,
    }
    waits = {v: station_at(stations, vehicles[v].position) for v in willing if v not in flying}
    saved = any(depot is not None and stations[depot].helps() for depot in waits.values())
    if params.end == "first_failure" and not flying and not saved:
        outcome["cause"] = UAV
        after["slot"] += 1 if params.count_unfinished_slot else 0
        return after, outcome

    after["slot"] += 1
    after["elapsed"] += plan.duration
    outcome["duration"] = plan.duration
    guests = {v: (depot, 0.0) for v, depot in waits.items() if depot is not None}
    for v in waits:
        after["grounded"][v] = waits[v] is None
    for v in flying:
        after["uav_position"][v] = spots[v]
        after["uav_energy"][v] -= plan.cost[v]
        outcome["paid"][v] = plan.cost[v]
        if places[v] >= n:
            guests[v] = (station_at(stations, spots[v]), flights[v])
    serve_at_depots(vehicles, stations, guests, after["uav_energy"], plan.duration)
    after["packs"] = np.array([station.packs for station in stations])

    for d in living:
        served = plan.uploader[d] is not None
        outcome["served"][d] = served
        after["age"][d] = 0 if served else after["age"][d] + (0 if layout.has_comms[d] else 1)
        if not layout.has_power[d]:
            sending = plan.upload[d] if served else plan.report[d]
            work = float(layout.active_power[d]) * plan.compute[d] + float(params.transmit_power_w) * sending
            outcome["drain"][d] = float(layout.standby_power[d]) * plan.duration + work
            if not edge.at_least(after["battery"][d], outcome["drain"][d]):
                after["battery"][d] = outcome["drain"][d]
            after["battery"][d] -= outcome["drain"][d]
    judge(params, layout, state, living, after, outcome, edge)
    outcome["edge"] = edge.nearest
    return after, outcome


def judge(params, layout, state, living, after, outcome, edge):
    """Find out who failed in a slot that was played, and whether it was the last one."""
    empty = [d for d in living if after["battery"][d] <= 0]
    over = [d for d in living if after["age"][d] >= expiry(params)]
    if params.end == "horizon":
        over = [d for d in over if state.age[d] < expiry(params)]
    for d in empty:
        after["failed_at"][d] = after["slot"]
    outcome["failed"][empty + over] = True
    first = over
    if empty:
        lasts = {d: float(state.battery[d]) / outcome["drain"][d] for d in empty}
        soonest = min(lasts.values())
        first = [d for d in empty if lasts[d] == soonest]
        for d in empty:
            if d not in first:
                edge.at_least(lasts[d], soonest)
    for d in first:
        outcome["first_failure"][d] = 1 / len(first)
    if params.end == "first_failure":
        outcome["cause"] = BATTERY if empty else DATA_AGE if over else NONE
        return
    present = present_devices(layout)
    dead = sum(after["failed_at"][d] >= 0 for d in present)
    if dead >= math.ceil(float(params.end_share) * len(present) - 1e-6):
        outcome["cause"] = SHARE
    elif edge.at_least(after["elapsed"], float(params.horizon_s)):
        outcome["cause"] = HORIZON


def reference_reward_terms(params, layout, before, action, after):
    """Return the plain terms A, O, M, U and S of a slot between two of the package's states."""
    n = len(layout.capacity)
    living, left = living_devices(layout, before), living_devices(layout, after)
    places = chosen_places(layout, action, read_stations(layout, before))
    vehicles = read_vehicles(params, layout, before)
    targets = [p for p, one in zip(places, vehicles, strict=True) if not one.grounded and p in living]
    priority = np.ones(n) if layout.priority is None else array(layout.priority)
    works = [d for d in left if after.age[d] < expiry(params)]
    return {
        "A": max((int(before.age[d]) for d in targets), default=0),
        "O": max((int(before.age[d]) for d in living), default=0),
        "M": min((float(after.battery[d]) / float(layout.capacity[d]) for d in living), default=0.0),
        "U": int(after.slot),
        "S": sum(priority[d] for d in works) / sum(priority[d] for d in present_devices(layout)),
    }

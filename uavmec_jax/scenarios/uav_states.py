"""The part of a state file that is about UAVs and depots."""

from collections.abc import Callable, Sequence
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float, Num
from pydantic import Field

from uavmec_jax.env.fleet import DepotKind
from uavmec_jax.env.layout import fleet_of
from uavmec_jax.files.validation import LARGEST_WHOLE, StrictModel, from_array
from uavmec_jax.scenarios.inventory import place_at
from uavmec_jax.scenarios.named_scenario import NamedScenario
from uavmec_jax.scenarios.schema import label

Number = Annotated[float, Field(allow_inf_nan=True)]
"""A number whose range is checked in a message that names the device or UAV."""


Whole = Annotated[int, Field(ge=-LARGEST_WHOLE, le=LARGEST_WHOLE)]
"""A whole number whose range is checked in a message that names the device."""


class UavState(StrictModel):
    """State of one UAV; what is left out is as in the initial state."""

    at: str | None = None
    """Name of the place where it is."""
    position_m: Annotated[tuple[Number, Number] | None, from_array] = None
    """Its position, metres from the origin."""
    energy_j: Number | None = None
    """Energy left, J."""
    grounded: bool | None = None
    """Whether it is out for the rest of the episode; by default, whether it has no energy and is at no depot."""


class UavStates(StrictModel):
    """The settings of a state file that are about UAVs and depots; what is left out is as in the initial state."""

    uav_at: str | None = None
    """Name of the place where the only UAV is."""
    uav_position_m: Annotated[tuple[Number, Number] | None, from_array] = None
    """Position of the only UAV, metres from the origin."""
    uav_energy_j: Number | None = None
    """Energy left in the only UAV, J."""
    uavs: dict[str, UavState] = Field(default_factory=dict)
    """The UAVs by name; a file may list them in order instead."""
    packs: Annotated[tuple[Number, ...] | dict[str, Number] | None, from_array] = None
    """Full batteries left in stock at each depot."""


_ALONE = "uav_"
"""What messages put in front of a setting of the only UAV."""


def name_uavs(data: dict[str, Any], scenario: NamedScenario) -> dict[str, Any]:
    """Return the data of a state file with ``uavs`` by name, also if they are a list.

    Raises:
        ValueError: the list has not one entry per UAV.
    """
    if not isinstance(uavs := data.get("uavs"), list | tuple):
        return data
    if len(uavs) != len(scenario.uav_names):
        raise ValueError(f"uavs has {len(uavs)} values; give {len(scenario.uav_names)}, one for each UAV")
    return data | {"uavs": dict(zip(scenario.uav_names, uavs, strict=True))}


def by_name(
    field: str, values: Any, defaults: Num[np.ndarray, " m"], names: Sequence[str], what: str
) -> Num[np.ndarray, " m"]:
    """Return one value per name, from a list in their order or from a dictionary with some of them.

    Args:
        field: name of the setting, for messages.
        values: the list or the dictionary; ``None`` if the file has neither.
        defaults: values of the names that are left out.
        names: names of the devices or depots.
        what: ``"device"`` or ``"depot"``, for messages.

    Raises:
        ValueError: a name is unknown, or the list has another length; one line.
    """
    if values is None:
        return defaults
    if isinstance(values, dict):
        for name in values:
            if name not in names:
                raise ValueError(f"{field} names {name!r}; the {what}s are {', '.join(names)}")
        return np.array([values.get(name, default) for name, default in zip(names, defaults, strict=True)])
    if len(values) != len(names):
        raise ValueError(f"{field} has {len(values)} values; give {len(names)}, one for each {what}")
    return np.array(values)


def uav_arrays(
    file: UavStates, scenario: NamedScenario
) -> tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, " K"], Bool[np.ndarray, " K"]]:
    """Return where the UAVs are, m, their energies, J, and which of them are grounded: also those without any energy.

    Raises:
        ValueError: a value does not fit its UAV; one line that names both.
    """
    names = scenario.uav_names
    alone = {
        name: value for name in ("at", "position_m", "energy_j") if (value := getattr(file, _ALONE + name)) is not None
    }
    if alone and (len(names) > 1 or file.uavs):
        given = f"{_ALONE}{next(iter(alone))} is given, "
        if file.uavs:
            raise ValueError(f"{given}and uavs too; leave one of them out")
        raise ValueError(f"{given}but there are {len(names)} UAVs; give uavs: their names, each with at, energy_j, ...")
    if unknown := [name for name in file.uavs if name not in names]:
        raise ValueError(f"uavs names {unknown[0]!r}; the UAVs are {', '.join(names)}")
    if alone:
        entries = [(_ALONE, UavState(**alone))]
    else:
        entries = [
            (f"{label('uav', number, name)}: ", file.uavs.get(name, UavState())) for number, name in enumerate(names, 1)
        ]
    position = np.array([_position(field, uav, v, scenario) for v, (field, uav) in enumerate(entries)])
    energy = np.array([_energy(field, uav, v, scenario) for v, (field, uav) in enumerate(entries)])
    uavs = zip(entries, position, energy.tolist(), strict=True)
    grounded = [_is_grounded(uav, where, left, scenario) for (_, uav), where, left in uavs]
    return position, energy, np.array(grounded)


def _is_grounded(uav: UavState, position: Float[np.ndarray, "2"], energy: float, scenario: NamedScenario) -> bool:
    """Return whether a UAV is grounded; if the file does not say it, whether it has no energy and is at no depot."""
    if uav.grounded is not None:
        return uav.grounded
    depots = np.asarray(scenario.layout.places())[scenario.layout.n_devices :]
    return energy == 0 and place_at(position, depots, scenario.depot_names) is None


def _position(field: str, uav: UavState, v: int, scenario: NamedScenario) -> Float[np.ndarray, "2"]:
    """Return where UAV ``v`` is; ``field`` is what messages put in front of the name of a setting."""
    if uav.at is not None and uav.position_m is not None:
        also = field if field == _ALONE else ""
        raise ValueError(f"{field}at and {also}position_m are both given; leave one of them out")
    if uav.at is not None:
        names = scenario.place_names
        if uav.at not in names:
            what = "places" if scenario.depot_names else "devices"
            raise ValueError(f"{field}at is {uav.at!r}; the {what} are {', '.join(names)}")
        return np.asarray(scenario.layout.places()[names.index(uav.at)])
    if uav.position_m is None:
        return np.asarray(scenario.state.uav_position[v])
    position, sides = np.array(uav.position_m), np.asarray(scenario.params.region_m, float)
    if not np.all(np.isfinite(position)) or np.any(position < -sides) or np.any(position > 2 * sides):
        raise ValueError(
            f"{field}position_m is {position.tolist()}; give metres in or near the region of {sides.tolist()}"
        )
    return position.astype(np.float32)


def _energy(field: str, uav: UavState, v: int, scenario: NamedScenario) -> float:
    """Return the energy of UAV ``v``; only where the episode then goes on may it be empty."""
    battery = float(np.asarray(fleet_of(scenario.params, scenario.layout).battery_j[v], float))
    energy = battery if uav.energy_j is None else uav.energy_j
    layout = scenario.layout
    may_be_empty = layout.n_uavs > 1 or layout.n_depots > 0 or scenario.params.end == "horizon"
    if not 0 <= energy <= battery * (1 + 1e-6) or (energy == 0 and not may_be_empty):
        least = "from 0 to" if may_be_empty else "more than 0 and at most"
        raise ValueError(f"{field}energy_j is {energy:g}; give {least} {battery:g}")
    return min(energy, battery)


def depot_packs(packs: Any, scenario: NamedScenario) -> Float[np.ndarray, " D"]:
    """Return how many full batteries the depots have in stock.

    Raises:
        ValueError: there are no depots, one of them charges, or a number is not whole or above its stock at the start.
    """
    depots, names, stock = scenario.layout.depots, scenario.depot_names, np.asarray(scenario.state.packs, float)
    if packs is None:
        return stock
    if depots is None:
        raise ValueError("packs is given, but there are no depots; leave it out")
    left = by_name("packs", packs, stock, names, "depot").astype(float)
    for number, (name, has, had, kind) in enumerate(zip(names, left, stock, np.asarray(depots.kind), strict=True), 1):
        where = f"{label('depot', number, name)}: packs is {has:g}"
        if kind == DepotKind.CHARGE and has != np.inf:
            raise ValueError(f"{where}, but it charges batteries; give packs by name, without this depot")
        if not 0 <= has <= had or (has != np.floor(has)):
            at_most = "" if had == np.inf else f" to {had:g}, its stock at the start"
            raise ValueError(f"{where}; give a whole number from 0{at_most}")
    return left


def uav_data(scenario: NamedScenario, number: Callable[[Any], float]) -> dict[str, Any]:
    """Return ``uavs`` and ``packs`` of a state file; what is as in the initial state may be left out.

    Args:
        scenario: the scenario in its present state.
        number: turns a 32-bit float into a number of the file.
    """
    state, packs = scenario.state, np.asarray(scenario.state.packs)
    positions = np.asarray(state.uav_position)
    places = np.asarray(scenario.layout.places())
    where = [place_at(position, places, scenario.place_names) for position in positions]
    return {
        "uavs": {
            name: ({"position_m": [number(x) for x in positions[v]]} if where[v] is None else {"at": where[v]})
            | {"energy_j": number(state.uav_energy[v]), "grounded": bool(state.grounded[v])}
            for v, name in enumerate(scenario.uav_names)
        },
        "packs": {
            name: number(left) for name, left in zip(scenario.depot_names, packs, strict=True) if np.isfinite(left)
        },
    }

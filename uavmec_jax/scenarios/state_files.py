"""State files: where a network stands in the middle of its life, in JSON, checked against its scenario."""

import json
import math
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
import pydantic
from pydantic import Field

from uavmec_jax.env.dynamics import State, initial_state, slots_to_expiry
from uavmec_jax.errors import StateError
from uavmec_jax.files.reading import read_text
from uavmec_jax.files.validation import StrictModel, describe_error, from_array
from uavmec_jax.scenarios.named_scenario import NamedScenario

_Number = Annotated[float, Field(allow_inf_nan=True)]  # a NaN gets a message of ours, with the device's name


class StateFile(StrictModel):
    """A state file; whatever is left out is as before the first slot."""

    battery_j: Annotated[tuple[_Number, ...] | dict[str, _Number] | None, from_array] = None
    """J left in each device, in the order of the scenario file or by name."""
    age_slots: Annotated[tuple[int, ...] | dict[str, int] | None, from_array] = None
    """Slots since each device's data last got out."""
    uav_at: str | None = None
    """The device that the UAV hovers above."""
    uav_position_m: Annotated[tuple[_Number, _Number] | None, from_array] = None
    """Where the UAV is, metres from the corner where it started."""
    uav_energy_j: _Number | None = None
    """J left in the UAV."""
    slot: Annotated[int, Field(ge=0)] = 0
    """Slots completed."""
    elapsed_s: Annotated[float, Field(ge=0)] = 0.0
    """Length of the slots completed, s."""


def load_state(path: str | Path, scenario: NamedScenario) -> State:
    """Read a state file and check it against its scenario.

    Raises:
        StateError: the file is missing, or something in it does not fit; one line.
    """
    path = Path(path)
    text = read_text(path, StateError)
    try:
        data = json.loads(text)
    except ValueError as error:
        raise StateError(f"{path}: is not JSON: {error}") from None
    if not isinstance(data, dict):
        raise StateError(f'{path}: holds {type(data).__name__}, not an object; give e.g. {{"age_slots": [0, 3, 1]}}')
    return make_state(data, scenario, str(path))


def make_state(data: dict[str, Any], scenario: NamedScenario, source: str) -> State:
    """Check plain data as a state file holds it, and make the state; ``source`` names it in messages.

    Raises:
        StateError: as :func:`load_state`.
    """
    try:
        given = StateFile.model_validate(data)
    except pydantic.ValidationError as error:
        raise StateError(describe_error(source, error, StateFile)) from None
    try:
        return _build(given, scenario)
    except ValueError as error:
        raise StateError(f"{source}: {error}") from None


def _build(given: StateFile, scenario: NamedScenario) -> State:
    params, layout = scenario.params, scenario.layout
    fresh = initial_state(params, layout)
    battery = _by_device("battery_j", given.battery_j, np.asarray(fresh.battery, float), scenario)
    age = _by_device("age_slots", given.age_slots, np.asarray(fresh.age), scenario)
    limit, capacity = int(slots_to_expiry(params)), np.asarray(layout.capacity, float)
    for device, name in enumerate(scenario.device_names):
        where = f"device {device + 1} ({name}): "
        if not 0 < battery[device] <= capacity[device] * (1 + 1e-6):
            raise ValueError(
                f"{where}battery_j is {battery[device]:g}; give more than 0 and at most {capacity[device]:g}, its capacity"
            )
        if not 0 <= age[device] < limit:
            raise ValueError(f"{where}age_slots is {age[device]}; give 0 to {limit - 1}: older data have expired")
    energy = float(params.uav_battery_j) if given.uav_energy_j is None else given.uav_energy_j
    if not 0 < energy <= float(params.uav_battery_j) * (1 + 1e-6):
        raise ValueError(f"uav_energy_j is {energy:g}; give more than 0 and at most {float(params.uav_battery_j):g}")
    return State(
        battery=jnp.asarray(np.minimum(battery, capacity), jnp.float32),
        age=jnp.where(layout.has_comms, 0, jnp.asarray(age, jnp.int32)),
        uav_position=jnp.asarray(_uav_position(given, scenario), jnp.float32),
        uav_energy=jnp.float32(min(energy, float(params.uav_battery_j))),
        slot=jnp.int32(given.slot),
        elapsed=jnp.float32(given.elapsed_s),
    )


def _by_device(field: str, given: Any, default: np.ndarray, scenario: NamedScenario) -> np.ndarray:
    """One value per device, from a list in their order or from some of their names."""
    names = scenario.device_names
    if given is None:
        return default
    if isinstance(given, dict):
        for name in given:
            if name not in names:
                raise ValueError(f"{field} names {name!r}; the devices are {', '.join(names)}")
        return np.array([given.get(name, own) for name, own in zip(names, default, strict=True)])
    if len(given) != len(names):
        raise ValueError(f"{field} has {len(given)} values; give {len(names)}, one for each device")
    return np.array(given)


def _uav_position(given: StateFile, scenario: NamedScenario) -> np.ndarray:
    """Metres from the corner."""
    if given.uav_at is not None and given.uav_position_m is not None:
        raise ValueError("uav_at and uav_position_m are both given; leave one of them out")
    if given.uav_at is not None:
        if given.uav_at not in scenario.device_names:
            raise ValueError(f"uav_at is {given.uav_at!r}; the devices are {', '.join(scenario.device_names)}")
        return np.asarray(scenario.layout.position[scenario.device_names.index(given.uav_at)])
    place = np.zeros(2) if given.uav_position_m is None else np.array(given.uav_position_m)
    sides = np.asarray(scenario.params.region_m, float)
    if not all(math.isfinite(x) for x in place) or np.any(place < -sides) or np.any(place > 2 * sides):
        raise ValueError(f"uav_position_m is {place.tolist()}; give metres in or near the region of {sides.tolist()}")
    return place


def state_data(scenario: NamedScenario) -> dict[str, Any]:
    """The present state of a scenario as plain data, as a state file holds it."""
    state, names = scenario.state, scenario.device_names
    return {
        "battery_j": {n: round(float(j), 3) for n, j in zip(names, np.asarray(state.battery), strict=True)},
        "age_slots": {n: int(a) for n, a in zip(names, np.asarray(state.age), strict=True)},
        "uav_position_m": [round(float(x), 3) for x in np.asarray(state.uav_position)],
        "uav_energy_j": round(float(state.uav_energy), 3),
        "slot": int(state.slot),
        "elapsed_s": round(float(state.elapsed), 3),
    }

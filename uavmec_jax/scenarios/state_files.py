"""Read and write state files: the present state of a network, in JSON, checked against its scenario."""

import json
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Int, Num
from pydantic import Field

from uavmec_jax.env.dynamics import State, complete_state, slots_to_expiry
from uavmec_jax.errors import StateError
from uavmec_jax.files.reading import read_text
from uavmec_jax.files.validation import StrictModel, describe_error, from_array
from uavmec_jax.scenarios.named_scenario import NamedScenario

_Number = Annotated[float, Field(allow_inf_nan=True)]  # refused below, in a message that names the device


class StateFile(StrictModel):
    """Contents of a state file; what is left out is as in the initial state."""

    battery_j: Annotated[tuple[_Number, ...] | dict[str, _Number] | None, from_array] = None
    """Energy left in each device, J, in the order of the scenario file or by name."""
    age_slots: Annotated[tuple[int, ...] | dict[str, int] | None, from_array] = None
    """Slots since each device's data were last delivered."""
    uav_at: str | None = None
    """Name of the device above which the UAV hovers."""
    uav_position_m: Annotated[tuple[_Number, _Number] | None, from_array] = None
    """Position of the UAV, metres from the corner where it started."""
    uav_energy_j: _Number | None = None
    """Energy left in the UAV, J."""
    slot: Annotated[int, Field(ge=0)] = 0
    """Number of completed slots."""
    elapsed_s: Annotated[float, Field(ge=0)] = 0.0
    """Duration of the completed slots, s."""


def load_state(path: str | Path, scenario: NamedScenario) -> State:
    """Read a state file and check it against its scenario.

    Raises:
        StateError: the file is missing, or a value in it does not fit the scenario; one line.
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
    """Make a state from the data of a state file.

    Args:
        data: contents of the file, as parsed from JSON.
        scenario: the scenario, in its initial state.
        source: name of the file, for messages.

    Raises:
        StateError: a value does not fit the scenario; one line that names it.
    """
    try:
        file = StateFile.model_validate(data)
    except pydantic.ValidationError as error:
        raise StateError(describe_error(source, error, StateFile)) from None
    try:
        return _build(file, scenario)
    except ValueError as error:
        raise StateError(f"{source}: {error}") from None


def _build(file: StateFile, scenario: NamedScenario) -> State:
    capacity, uav_battery = np.asarray(scenario.layout.capacity, float), float(scenario.params.uav_battery_j)
    battery = _by_device("battery_j", file.battery_j, np.asarray(scenario.state.battery, float), scenario)
    age = _by_device("age_slots", file.age_slots, np.asarray(scenario.state.age), scenario)
    _check_devices(battery, age, scenario)
    energy = uav_battery if file.uav_energy_j is None else file.uav_energy_j
    if not 0 < energy <= uav_battery * (1 + 1e-6):
        raise ValueError(f"uav_energy_j is {energy:g}; give more than 0 and at most {uav_battery:g}")
    state = State(
        battery=jnp.asarray(np.minimum(battery, capacity), jnp.float32),
        age=jnp.where(scenario.layout.has_comms, 0, jnp.asarray(age, jnp.int32)),
        uav_position=jnp.asarray(_uav_position(file, scenario), jnp.float32)[None],
        uav_energy=jnp.float32(min(energy, uav_battery))[None],
        slot=jnp.int32(file.slot),
        elapsed=jnp.float32(file.elapsed_s),
    )
    return complete_state(scenario.layout, state)


def _check_devices(battery: Num[np.ndarray, " n"], age: Int[np.ndarray, " n"], scenario: NamedScenario) -> None:
    """Check that no battery is empty or above its capacity, and that no data have expired."""
    limit = int(slots_to_expiry(scenario.params))
    capacities = np.asarray(scenario.layout.capacity, float)
    devices = zip(scenario.device_names, battery, age, capacities, strict=True)
    for number, (name, energy, slots, capacity) in enumerate(devices, 1):
        where = f"device {number} ({name}): "
        if not 0 < energy <= capacity * (1 + 1e-6):
            raise ValueError(f"{where}battery_j is {energy:g}; give more than 0 and at most {capacity:g}, its capacity")
        if not 0 <= slots < limit:
            raise ValueError(f"{where}age_slots is {slots}; give 0 to {limit - 1}: older data have expired")


def _by_device(
    field: str, values: Any, defaults: Num[np.ndarray, " n"], scenario: NamedScenario
) -> Num[np.ndarray, " n"]:
    """Return one value per device, from a list in their order or from a dictionary with some of their names."""
    names = scenario.device_names
    if values is None:
        return defaults
    if isinstance(values, dict):
        for name in values:
            if name not in names:
                raise ValueError(f"{field} names {name!r}; the devices are {', '.join(names)}")
        return np.array([values.get(name, default) for name, default in zip(names, defaults, strict=True)])
    if len(values) != len(names):
        raise ValueError(f"{field} has {len(values)} values; give {len(names)}, one for each device")
    return np.array(values)


def _uav_position(file: StateFile, scenario: NamedScenario) -> Num[np.ndarray, "2"]:
    """Return the position of the UAV in metres from the corner where it started."""
    if file.uav_at is not None and file.uav_position_m is not None:
        raise ValueError("uav_at and uav_position_m are both given; leave one of them out")
    if file.uav_at is not None:
        if file.uav_at not in scenario.device_names:
            raise ValueError(f"uav_at is {file.uav_at!r}; the devices are {', '.join(scenario.device_names)}")
        return np.asarray(scenario.layout.position[scenario.device_names.index(file.uav_at)])
    position = np.zeros(2) if file.uav_position_m is None else np.array(file.uav_position_m)
    sides = np.asarray(scenario.params.region_m, float)
    if not np.all(np.isfinite(position)) or np.any(position < -sides) or np.any(position > 2 * sides):
        raise ValueError(
            f"uav_position_m is {position.tolist()}; give metres in or near the region of {sides.tolist()}"
        )
    return position


def state_data(scenario: NamedScenario) -> dict[str, Any]:
    """Return the present state of a scenario as the contents of a state file."""
    state, names = scenario.state, scenario.device_names
    battery, age = np.asarray(state.battery), np.asarray(state.age)
    return {
        "battery_j": {name: round(float(energy), 3) for name, energy in zip(names, battery, strict=True)},
        "age_slots": {name: int(slots) for name, slots in zip(names, age, strict=True)},
        "uav_position_m": [round(float(x), 3) for x in np.asarray(state.uav_position)[0]],
        "uav_energy_j": round(float(state.uav_energy[0]), 3),
        "slot": int(state.slot),
        "elapsed_s": round(float(state.elapsed), 3),
    }

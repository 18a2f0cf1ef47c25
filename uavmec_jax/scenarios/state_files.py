"""Read and write state files: the present state of a network, in JSON, checked against its scenario."""

from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, Num
from pydantic import Field

from uavmec_jax.env.dynamics import State, slots_to_expiry
from uavmec_jax.errors import StateError
from uavmec_jax.files.parsing import read_json_object
from uavmec_jax.files.validation import LARGEST, from_array, validated
from uavmec_jax.scenarios.named_scenario import NamedScenario
from uavmec_jax.scenarios.uav_states import (
    Number,
    UavStates,
    Whole,
    by_name,
    depot_packs,
    name_uavs,
    uav_arrays,
    uav_data,
)

_MAX_SLOTS = 1_000_000

_LEAST = float(np.finfo(np.float32).tiny)
"""Least energy of a battery that is not empty: in single precision, less counts as 0."""


class StateFile(UavStates):
    """Contents of a state file; what is left out is as in the initial state.

    Values of several devices, UAVs or depots are in the order of the scenario file or by name.
    """

    battery_j: Annotated[tuple[Number, ...] | dict[str, Number] | None, from_array] = None
    """Energy left in each device, J."""
    age_slots: Annotated[tuple[Whole, ...] | dict[str, Whole] | None, from_array] = None
    """Slots since each device's data were last delivered."""
    failed_at: Annotated[tuple[Whole, ...] | dict[str, Whole] | None, from_array] = None
    """Number of slots that were completed when each battery ran out, -1 for devices that work; only if ``params.end`` is
    ``horizon``."""
    slot: Annotated[int, Field(ge=0, le=_MAX_SLOTS)] = 0
    """Number of completed slots."""
    elapsed_s: Annotated[float, Field(ge=0, le=LARGEST)] = 0.0
    """Duration of the completed slots, s."""


def load_state(path: str | Path, scenario: NamedScenario) -> State:
    """Read a state file and check it against its scenario.

    Raises:
        StateError: the file is missing, or a value in it does not fit the scenario; one line.
    """
    path = Path(path)
    return make_state(read_json_object(path, StateError), scenario, str(path))


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
        return _build(validated(StateFile, name_uavs(data, scenario), source, StateError), scenario)
    except StateError:
        raise
    except ValueError as error:
        raise StateError(f"{source}: {error}") from None


def _build(file: StateFile, scenario: NamedScenario) -> State:
    names, initial = scenario.device_names, scenario.state
    capacity = np.asarray(scenario.layout.capacity, float)
    failed_at = by_name("failed_at", file.failed_at, np.asarray(initial.failed_at), names, "device")
    full = np.where(failed_at < 0, np.asarray(initial.battery, float), 0.0)
    battery = by_name("battery_j", file.battery_j, full, names, "device")
    age = by_name("age_slots", file.age_slots, np.asarray(initial.age), names, "device")
    _check_failures(file, failed_at, scenario)
    _check_time(file, scenario)
    _check_devices(battery, age, failed_at, scenario)
    position, energy, grounded = uav_arrays(file, scenario)
    return State(
        battery=jnp.asarray(np.minimum(battery, capacity), jnp.float32),
        age=jnp.where(scenario.layout.has_comms, 0, jnp.asarray(age, jnp.int32)),
        uav_position=jnp.asarray(position, jnp.float32),
        uav_energy=jnp.asarray(energy, jnp.float32),
        slot=jnp.int32(file.slot),
        elapsed=jnp.float32(file.elapsed_s),
        grounded=jnp.asarray(grounded),
        failed_at=jnp.asarray(failed_at, jnp.int32),
        packs=jnp.asarray(depot_packs(file.packs, scenario), jnp.float32),
    )


def _check_failures(file: StateFile, failed_at: Int[np.ndarray, " n"], scenario: NamedScenario) -> None:
    """Check that batteries ran out only where the episode goes on without them, and in slots that are completed."""
    if file.failed_at is not None and scenario.params.end != "horizon":
        raise ValueError(
            'failed_at is given, but the first failure ends the episode; leave it out, or give params.end = "horizon"'
        )
    for number, (name, slot) in enumerate(zip(scenario.device_names, failed_at, strict=True), 1):
        if not -1 <= slot <= file.slot:
            raise ValueError(
                f"device {number} ({name}): failed_at is {slot}; give 0 to {file.slot}, the number of completed slots, "
                "or -1 if it works"
            )


def _check_time(file: StateFile, scenario: NamedScenario) -> None:
    """Check that the episode is not over, and that time has passed in the slots that are completed if there is a horizon."""
    limit = int(scenario.params.max_slots)
    if file.slot >= limit:
        raise ValueError(f"slot is {file.slot}; episodes end after params.max_slots = {limit} slots; give less")
    if scenario.params.end != "horizon":
        return
    horizon = float(scenario.params.horizon_s)
    if file.elapsed_s >= horizon:
        raise ValueError(f"elapsed_s is {file.elapsed_s:g}; the horizon is {horizon:g} s; give less")
    if file.slot > 0 and "elapsed_s" not in file.model_fields_set:
        raise ValueError(f"elapsed_s is missing, but slot is {file.slot}; give the seconds that these slots took")


def _check_devices(
    battery: Num[np.ndarray, " n"],
    age: Int[np.ndarray, " n"],
    failed_at: Int[np.ndarray, " n"],
    scenario: NamedScenario,
) -> None:
    """Check that no battery is empty or above its capacity unless it failed, and that no data have expired."""
    goes_on = scenario.params.end == "horizon"
    limit = _MAX_SLOTS + 1 if goes_on else int(slots_to_expiry(scenario.params))
    capacities = np.asarray(scenario.layout.capacity, float)
    devices = zip(scenario.device_names, battery, age, failed_at, capacities, strict=True)
    for number, (name, energy, slots, failed, capacity) in enumerate(devices, 1):
        where = f"device {number} ({name}): "
        if failed >= 0 and energy != 0:
            raise ValueError(f"{where}battery_j is {energy:g}, but failed_at is given; leave one of them out")
        if failed < 0 and not _LEAST <= energy <= capacity * (1 + 1e-6):
            or_failed = ", or failed_at if it is empty" if goes_on else ""
            raise ValueError(
                f"{where}battery_j is {energy:g}; give more than 0 and at most {capacity:g}, its capacity{or_failed}"
            )
        if not 0 <= slots < limit:
            reason = "" if goes_on else ": older data have expired"
            raise ValueError(f"{where}age_slots is {slots}; give 0 to {limit - 1}{reason}")


def state_data(scenario: NamedScenario) -> dict[str, Any]:
    """Return the present state of a scenario as the contents of a state file.

    Numbers are rounded to thousandths where there is only the UAV of the parameters, no depot and no horizon; all others are
    exact.
    """
    state, names, layout = scenario.state, scenario.device_names, scenario.layout
    extended = layout.fleet is not None or layout.depots is not None or scenario.params.end == "horizon"
    number = _exact if extended else _rounded
    battery, age, failed_at = np.asarray(state.battery), np.asarray(state.age), np.asarray(state.failed_at)
    if extended:
        uavs = uav_data(scenario, number)
        uavs |= {"failed_at": {name: int(slot) for name, slot in zip(names, failed_at, strict=True) if slot >= 0}}
    else:
        uavs = {
            "uav_position_m": [number(x) for x in np.asarray(state.uav_position)[0]],
            "uav_energy_j": number(state.uav_energy[0]),
        }
    return {
        "battery_j": {name: number(energy) for name, energy in zip(names, battery, strict=True)},
        "age_slots": {name: int(slots) for name, slots in zip(names, age, strict=True)},
        **{field: value for field, value in uavs.items() if value},
        "slot": int(state.slot),
        "elapsed_s": number(state.elapsed),
    }


def _rounded(value: Any) -> float:
    return round(float(value), 3)


def _exact(value: Any) -> float:
    """Return the decimal number with the fewest digits that is the same as a 32-bit float."""
    return float(str(np.float32(value)))

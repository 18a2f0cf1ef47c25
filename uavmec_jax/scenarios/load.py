"""Load a scenario: from a file, or the random one that a seed stands for in every study."""

from dataclasses import replace
from numbers import Integral
from pathlib import Path
from typing import Any

from uavmec_jax.env.fleet import MAX_UAVS, DepotKind, make_depots, make_fleet
from uavmec_jax.env.params import Params
from uavmec_jax.errors import ScenarioError
from uavmec_jax.files.validation import validated
from uavmec_jax.scenarios.named_scenario import NamedScenario, name_scenario
from uavmec_jax.scenarios.places import on_place
from uavmec_jax.scenarios.scenario_files import load_scenario_file
from uavmec_jax.scenarios.seeds import layout_for_seed
from uavmec_jax.scenarios.settings import ParamsSettings, check_ranges
from uavmec_jax.scenarios.state_files import load_state
from uavmec_jax.traffic.evacuation import load_evacuation


def load_scenario(
    file: str | Path | None = None,
    *,
    state: str | Path | None = None,
    place: str | Path | None = None,
    powered: int = 8,
    connected: int = 8,
    seed: int = 0,
    uavs: int = 1,
    depot: str | None = None,
    settings: dict[str, Any] | None = None,
) -> NamedScenario:
    """Load a scenario.

    Args:
        file: scenario file, TOML or CSV; ``None`` for a random scenario.
        state: state file, JSON, with the present state of the network; ``None`` for the initial state.
        place: simulated evacuation, by name or file, that gives the devices of a random scenario their positions and traffic.
        powered: number of devices with grid power in a random scenario.
        connected: number of devices with communication in a random scenario.
        seed: seed of the random scenario and of the volume draws.
        uavs: number of UAVs in a random scenario, all like that of the parameters. Devices and draws do not depend on it.
        depot: kind of the depot, ``"swap"`` or ``"charge"``, at the origin of a random scenario; ``None`` for no depot.
        settings: scenario parameters to change, by name.

    Raises:
        ScenarioError: the file is not usable, or a number is out of range.
        StateError: the state does not fit the scenario.
        TrafficError: the place is not usable, or a hop in it would take longer than a slot may.
    """
    if not _is_whole(seed) or not 0 <= seed < 2**31:
        raise ScenarioError(f"seed is {seed}; give a whole number from 0 to {2**31 - 1}")
    if file is not None:
        scenario = replace(load_scenario_file(file, settings), draw_id=(seed, 0, 0))
    else:
        params = _make_params(settings or {})
        scenario = _random_scenario(params, place, powered, connected, seed, _vehicles(params, uavs, depot))
    return scenario if state is None else replace(scenario, state=load_state(state, scenario))


def _is_whole(number: Any) -> bool:
    """Return whether a number is an integer, Python's or NumPy's."""
    return isinstance(number, Integral) and not isinstance(number, bool)


def _vehicles(params: Params, uavs: int, depot: str | None) -> dict[str, Any]:
    """Return the UAVs and the depot as fields of a layout; ``None`` for one UAV and for no depot."""
    if not _is_whole(uavs) or not 1 <= uavs <= MAX_UAVS:
        raise ScenarioError(f"uavs is {uavs}; give 1 to {MAX_UAVS}")
    kinds = [kind.name.lower() for kind in DepotKind]
    if depot is not None and depot not in kinds:
        raise ScenarioError(f"depot is {depot!r}; give {' or '.join(kinds)}")
    depots = None if depot is None else make_depots([[0.0, 0.0]], depot)
    return {"depots": depots, "fleet": make_fleet(params, uavs, depots) if uavs > 1 else None}


def _random_scenario(
    params: Params,
    place: str | Path | None,
    powered: int,
    connected: int,
    seed: int,
    vehicles: dict[str, Any],
) -> NamedScenario:
    """Return the scenario that studies train agents of this seed and these counts on, with UAVs and depots added."""
    evacuation = None if place is None else load_evacuation(place)
    if evacuation is not None:
        params = replace(params, n_devices=evacuation.n_devices, region_m=evacuation.region_m())
        evacuation.check_hops(float(params.uav_speed_m_s), float(params.slot_cap_s))
    for name, count in (("powered", powered), ("connected", connected)):
        if not _is_whole(count) or not 0 <= count <= params.n_devices:
            raise ScenarioError(f"{name} is {count}; give 0 to {params.n_devices}, the number of devices")
    layout = layout_for_seed(seed, params, powered, connected)
    name, device_names = f"{powered} powered, {connected} connected, seed {seed}", None
    if evacuation is not None:
        layout = on_place(layout, evacuation)
        name, device_names = f"{evacuation.name}, {name}", evacuation.meta["names"]
    layout = replace(layout, **vehicles)
    name += f", {layout.n_uavs} UAVs" * (layout.n_uavs > 1) + ", 1 depot" * layout.n_depots
    named = name_scenario(layout, params, name, device_names)
    return replace(named, layout=replace(named.layout, traffic=layout.traffic), draw_id=(seed, powered, connected))


def _make_params(settings: dict[str, Any]) -> Params:
    """Return Table 1 with some parameters changed."""
    checked = validated(ParamsSettings, settings, "--set", ScenarioError)
    try:
        check_ranges(checked, "")
    except ValueError as error:
        raise ScenarioError(f"--set: {error}") from None
    return Params(**checked.model_dump())

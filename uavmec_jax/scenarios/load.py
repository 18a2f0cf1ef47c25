"""One scenario to plan for or to judge a policy on: a layout file, or the town that a seed stands for in every study."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pydantic
from jaxtyping import Array, Key

from uavmec_jax.env.params import Params
from uavmec_jax.errors import StudyError
from uavmec_jax.files.validation import one_line, tuples
from uavmec_jax.scenarios.named_scenario import Inventory, inventory_of
from uavmec_jax.scenarios.places import on_place
from uavmec_jax.scenarios.scenario_files import load_inventory
from uavmec_jax.scenarios.seeds import held_out_draws, town
from uavmec_jax.scenarios.settings import ParamsSettings, check_ranges
from uavmec_jax.traffic.evacuation import load_evacuation

MOST_DRAWS = 10_000


def load_scenario(
    source: Path | None,
    *,
    place: str | Path | None = None,
    powered: int = 8,
    connected: int = 8,
    seed: int = 0,
    draws: int = 8,
    settings: dict[str, Any] | None = None,
) -> tuple[Inventory, Key[Array, " D"]]:
    """The devices to plan for, and the volume draws to judge a plan on.

    Args:
        source: a layout file; ``None`` for the town of ``seed`` with so many powered and connected devices, and the
            draws that studies hold out for it.
        place: a simulated evacuation whose devices' positions that town has.
        powered: devices with grid power.
        connected: devices with communication.
        seed: of the town, and of the draws.
        draws: how many.
        settings: scenario parameters to change, by name.

    Raises:
        LayoutError: the layout file is not usable.
        TrafficError: the place is not usable, or a hop in it would take longer than a slot may.
        StudyError: a number does not fit.
    """
    settings = tuples(settings or {})
    for name, value, most in (("seed", seed, 2**31 - 1), ("draws", draws, MOST_DRAWS)):
        if not (name == "draws") <= value <= most:
            raise StudyError(f"--{name} is {value}; give a whole number from {int(name == 'draws')} to {most}")
    if source is not None:
        return load_inventory(source, settings), held_out_draws(seed, 0, 0, draws)
    params = _params(settings)
    evacuation = None if place is None else load_evacuation(place)
    if evacuation is not None:
        params = replace(params, n_devices=evacuation.n_devices, region_m=evacuation.region_m())
        evacuation.check_hops(params.uav_speed_m_s, params.slot_cap_s)
    for name, count in (("powered", powered), ("connected", connected)):
        if not 0 <= count <= params.n_devices:
            raise StudyError(f"--{name} is {count}; give 0 to {params.n_devices}, the number of devices")
    layout = town(seed, params, powered, connected)
    name = f"{powered} powered, {connected} connected, seed {seed}"
    keys = held_out_draws(seed, powered, connected, draws)
    if evacuation is None:
        return inventory_of(layout, params, name), keys
    there = on_place(layout, evacuation)
    inventory = inventory_of(there, params, f"{evacuation.name}, {name}", evacuation.meta["names"])
    return replace(inventory, layout=replace(inventory.layout, traffic=there.traffic)), keys


def _params(settings: dict[str, Any]) -> Params:
    try:
        checked = ParamsSettings.model_validate(settings)
        check_ranges(checked, "")
    except pydantic.ValidationError as error:
        raise StudyError(one_line("--set", error, ParamsSettings)) from None
    except ValueError as error:
        raise StudyError(f"--set: {error}") from None
    return Params(**checked.model_dump())

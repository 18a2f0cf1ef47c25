"""Advice to a fleet, or until a horizon: what each UAV does next, and when it returns to a depot."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from uavmec_jax.env.depots import can_help
from uavmec_jax.env.fleet import DepotKind
from uavmec_jax.env.layout import fleet_of
from uavmec_jax.planning.advice import RETURN_SLOTS, Advice, Candidate, UavAdvice
from uavmec_jax.reporting.labels import duration, place_label
from uavmec_jax.scenarios.named_scenario import NamedScenario

_RANKS = 3
"""Candidates of each UAV on the terminal; ``--json`` has all."""

_MAX_UAVS = 12
"""UAVs on the terminal."""

_DO = {
    "visit": "visit {}",
    "stay": "stay at {}",
    "swap": "swap at {}",
    "charge": "charge at {}",
    "wait": "wait at {}",
    "grounded": "grounded",
}


def next_actions(advice: Advice, scenario: NamedScenario) -> list[str]:
    """Return what each UAV does at the place that it is advised to go to: one of visit, stay, swap, charge, wait, grounded.

    A UAV stays if it is there already, and waits at a depot that has no pad or no pack for it.
    """
    layout, state = scenario.layout, scenario.state
    places, capacity = np.asarray(layout.places()), np.asarray(fleet_of(scenario.params, layout).battery_j)
    depots, free = layout.depots, _free_pads(scenario)
    actions = []
    for v, uav in enumerate(advice.uavs):
        here = bool(np.all(np.asarray(state.uav_position[v]) == places[uav.place]))
        depot = uav.place - layout.n_devices
        if state.grounded[v]:
            actions.append("grounded")
        elif depots is None or depot < 0 or (here and float(state.uav_energy[v]) >= capacity[v]):
            actions.append("stay" if here else "visit")
        elif free[depot] < 1:
            actions.append("wait")
        else:
            free[depot] -= 1
            actions.append(DepotKind(int(depots.kind[depot])).name.lower())
    return actions


def _free_pads(scenario: NamedScenario) -> list[float]:
    """Return how many UAVs each depot can serve in the next slot."""
    depots, packs = scenario.layout.depots, scenario.state.packs
    if depots is None:
        return []
    served = np.where(depots.kind == DepotKind.SWAP, np.minimum(depots.pads, np.floor(packs)), depots.pads)
    return np.where(can_help(depots, packs), served, 0.0).tolist()


def fleet_next_data(advice: Advice, scenario: NamedScenario) -> dict[str, Any]:
    """Return ``uavs``: each with ``name``, ``next``, ``policy_says``, ``returns_in``, ``ranking``; places from 1.

    A UAV that is grounded has no next place and no ranking.
    """
    uavs = zip(scenario.uav_names, advice.uavs, next_actions(advice, scenario), strict=True)
    return {"uavs": [{"name": name} | _uav_data(uav, action, scenario.place_names) for name, uav, action in uavs]}


def _uav_data(uav: UavAdvice, action: str, names: Sequence[str]) -> dict[str, Any]:
    if action == "grounded":
        nowhere = {"place": None, "name": None, "action": action}
        return {"next": nowhere, "policy_says": None, "returns_in": None, "ranking": []}
    returns_in = {"slots": uav.returns_in, "seconds": round(uav.returns_in_s, 1)}
    return {
        "next": {"place": uav.place + 1, "name": names[uav.place], "action": action},
        "policy_says": {"place": uav.policy_choice + 1, "name": names[uav.policy_choice]},
        "returns_in": None if math.isnan(uav.returns_in) else returns_in,
        "ranking": [
            {"place": candidate.place + 1, "name": names[candidate.place], **_value(candidate)}
            for candidate in uav.candidates
        ],
    }


def _value(candidate: Candidate) -> dict[str, Any]:
    """Return what a candidate is worth, and how far it is behind the best."""
    value = {"lifetime": candidate.lifetime} if candidate.service is None else {"service": candidate.service}
    behind = {
        "behind": round(candidate.behind, 4),
        "behind_interval": [round(candidate.behind_low, 4), round(candidate.behind_high, 4)],
    }
    return {name: round(number, 4) for name, number in value.items()} | behind


def fleet_next_table(advice: Advice, scenario: NamedScenario) -> Table:
    """Return a table of where each UAV goes next, with the runners-up."""
    table = Table()
    of_service = advice.uavs[0].candidates[0].service is not None
    value, behind = ("in service", "behind,\npoints") if of_service else ("lifetime", "behind\nthe first")
    for column in ("UAV", "rank", "next", value, behind, "policy's\nchoice"):
        table.add_column(column, justify="right" if column in ("rank", value, behind) else "left")
    actions = next_actions(advice, scenario)
    for name, uav, action in list(zip(scenario.uav_names, advice.uavs, actions, strict=True))[:_MAX_UAVS]:
        for rank, candidate in enumerate(uav.candidates[:_RANKS], 1):
            table.add_row(
                name if rank == 1 else "",
                str(rank),
                _do(scenario, candidate.place, action if rank == 1 else None),
                *_numbers(candidate, rank),
                "yes" if candidate.place == uav.policy_choice else "",
                end_section=rank == min(_RANKS, len(uav.candidates)),
            )
            if action == "grounded":
                break
    return table


def _do(scenario: NamedScenario, place: int, action: str | None) -> str:
    label = place_label(scenario, place)
    return label if action is None else _DO[action].format(label)


def _numbers(candidate: Candidate, rank: int) -> tuple[str, str]:
    """Return the value of a candidate and how far it is behind, as in the columns of a table."""
    scale = 1.0 if candidate.service is None else 100.0
    value = f"{candidate.lifetime:.2f}" if candidate.service is None else f"{candidate.service:.1%}"
    half = (candidate.behind_high - candidate.behind_low) / 2
    return value, f"{scale * candidate.behind:.2f} ±{scale * half:.2f}" if rank > 1 else "-"


def fleet_next_lines(advice: Advice, scenario: NamedScenario) -> list[str]:
    """Say in a line for each UAV what it does next, and when it returns to a depot."""
    actions = next_actions(advice, scenario)
    lines = [
        f"{name}: {_do(scenario, uav.place, action)}{_return(uav, action) if scenario.depot_names else ''}."
        for name, uav, action in zip(scenario.uav_names, advice.uavs, actions, strict=True)
    ]
    more = len(lines) - _MAX_UAVS
    return [*lines[:_MAX_UAVS], *[f"{more} more UAVs are in --json."] * (more > 0)]


def _return(uav: UavAdvice, action: str) -> str:
    if action in ("swap", "charge", "wait", "grounded"):
        return ""
    if uav.returns_in == 0:
        return ""
    if math.isnan(uav.returns_in):
        return f"; no return to a depot within {RETURN_SLOTS} slots in most futures"
    slots = f"{uav.returns_in:g} slot{'s' * (uav.returns_in != 1)}"
    return f"; it returns to a depot in {duration(uav.returns_in_s)} ({slots})"

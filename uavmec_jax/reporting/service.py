"""Policies by lifetime or by service, and the measures of a tour, as tables and as plain data."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Num
from rich.table import Table

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.env.measures import ServiceMeasures
from uavmec_jax.planning.plan import Plan
from uavmec_jax.reporting.tables import display_name


def lifetime_table(plan: Plan) -> Table:
    """Return a table with one row per policy, the shortest mean lifetime first, and the upper bound last.

    Where an episode reaches the limit of slots, its lifetime, and the mean with it, is at least the number in the table.
    """
    limit = int(plan.params.max_slots)

    def slots(number: Any, form: str) -> str:
        return f"≥ {number:{form}}" if number >= limit else f"{number:{form}}"

    table = Table()
    for column in ("policy", "slots", "least", "most"):
        table.add_column(column, justify="left" if column == "policy" else "right")
    rows = _ladder(plan.lifetimes) | ({} if plan.bound is None else {"bound": plan.bound})
    for policy, lifetimes in rows.items():
        mean = f"{'≥ ' * bool(lifetimes.max() >= limit)}{lifetimes.mean():.2f}"
        table.add_row(display_name(policy), mean, slots(lifetimes.min(), "d"), slots(lifetimes.max(), "d"))
    return table


def service_table(service: Mapping[str, Num[np.ndarray, " D"]], bound: float) -> Table:
    """Return a table with one row per policy, the least service first, and the upper bound last.

    Args:
        service: share of the time to the horizon in which the devices are in service, by policy.
        bound: upper bound on it.
    """
    table = Table()
    for column in ("policy", "in service", "least", "most"):
        table.add_column(column, justify="left" if column == "policy" else "right")
    for policy, share in _ladder(service).items():
        table.add_row(display_name(policy), f"{share.mean():.1%}", f"{share.min():.1%}", f"{share.max():.1%}")
    table.add_row(display_name("bound"), f"{bound:.1%}")
    return table


def _ladder(values: Mapping[str, Num[np.ndarray, " D"]]) -> dict[str, Num[np.ndarray, " D"]]:
    return dict(sorted(values.items(), key=lambda item: item[1].mean()))


def measure_data(measures: ServiceMeasures) -> dict[str, Any]:
    """Return the means of the measures of ``D`` episodes as plain data; ``None`` for what does not occur.

    Args:
        measures: leaves ``[D]``.
    """
    fails = measures.first_failure_slot >= 0
    working = np.isfinite(measures.mean_age)
    return {
        "first_failure_slot": float(measures.first_failure_slot[fails].mean()) if fails.any() else None,
        "failure_share": float(fails.mean()),
        "in_service": float(measures.in_service.mean()),
        "mean_age": float(measures.mean_age[working].mean()) if working.any() else None,
        "age_95": float(measures.age_95[working].mean()) if working.any() else None,
        "flights": float(measures.flights.mean()),
        "energy_used_j": float(measures.energy_used_j.mean()),
        "packs_used": float(measures.packs_used.mean()),
    }


def measure_table(measures: ServiceMeasures, *, depots: bool) -> Table:
    """Return a table of :func:`measure_data`; packs are in it if there are depots."""
    data, table = measure_data(measures), Table()
    table.add_column("measure")
    table.add_column("mean", justify="right")

    def add(name: str, number: float | None, form: str, unit: str = "") -> None:
        table.add_row(name, "-" if number is None else f"{number:{form}}{unit}")

    add("slots to the first failure", data["first_failure_slot"], ".1f")
    add("devices in service", data["in_service"], ".1%")
    add("age of the data of working devices", data["mean_age"], ".2f", " slots")
    add("95 % of these data are at most", data["age_95"], ".1f", " slots old")
    add("flights", data["flights"], ".1f")
    add("energy that the UAVs used", data["energy_used_j"] / 1e6, ".2f", " MJ")
    if depots:
        add("batteries swapped", data["packs_used"], ".1f")
    return table


def most_common_first_cause(measures: ServiceMeasures) -> Cause:
    """Return the most common cause of the first failure in ``D`` episodes; ``NONE`` if no device fails in any."""
    causes = measures.first_failure_cause[measures.first_failure_slot >= 0]
    return Cause(int(np.bincount(causes).argmax())) if len(causes) else Cause.NONE

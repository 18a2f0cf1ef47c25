"""First failures in an evacuation: the paper's Table 7 and studies like it."""

from typing import Any

import pandas as pd
from rich.table import Table
from rich.text import Text

from uavmec_jax.reporting.formatting import axis_values, censored, column_name, half_interval, slots
from uavmec_jax.studies.axes import TRAFFIC_WEIGHTS
from uavmec_jax.studies.first_failures import LEARNED, first_failure_groups, traffic_claims, with_traffic
from uavmec_jax.studies.paper import TABLE7
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.schema import PLANNERS

_SHORT_NAMES = {
    "oldest_first": "oldest",
    "earliest_deadline": "deadline",
    "lowest_battery": "battery",
    "shortest_life": "life",
    "shortest_tour": "tour",
}
"""Policies whose names would make the columns too wide."""

_SIGNIFICANCE = 0.05


def _short_name(policy: str) -> str:
    return _SHORT_NAMES.get(policy, column_name(policy))


def traffic_label(cell: Any) -> str:
    """Return the weights of traffic in the reward: ``none``, ``visit 10`` (the paper's bonus), ``failure 100``, or both."""
    bonus, penalty = (float(cell[name]) for name in TRAFFIC_WEIGHTS)
    weights = [f"visit {bonus:g}"] * (bonus > 0) + [f"failure {penalty:g}"] * (penalty > 0)
    return " + ".join(weights) or "none"


def table7_tables(results: Results) -> dict[str, Table]:
    """Return tables by title: lifetimes, first failures of each place's devices, and the test of the paper's claim."""
    tables = {"Lifetime in slots, mean over the seeds ± 95 %": lifetime_table(results)}
    for name, counts in first_failure_groups(results).items():
        seeds = int(counts["seeds"].max())
        content = f"first failures of each device in {seeds} scenarios"
        tables[f"{name}: {content}; best weights by the weight of traffic in their reward"] = count_table(counts)
    claims = traffic_claims(results)
    if len(claims):
        tables["First failures on devices in high traffic, with traffic in the reward and without, seed by seed"] = (
            claim_table(claims)
        )
    return tables


def lifetime_table(results: Results) -> Table:
    """Return a table with one row per cell: trained policies with intervals, heuristics, planners."""
    cells, table = with_traffic(results.cells(), results.study), Table()
    axes = [axis for axis in cell_axes(results.study) if axis not in TRAFFIC_WEIGHTS]
    axes = [axis for axis in axes if cells[axis].nunique() > 1 or axis in ("powered", "connected")]
    learned = [name for name in LEARNED if name in cells]
    others = [name for name in results.policies if name not in LEARNED]
    planners = [f"{name}_planned" for name in PLANNERS if f"{name}_planned" in cells]
    shown = [*learned, *others, *planners]
    for axis in axes:
        table.add_column(axis)
    for name in ("traffic", *shown):
        table.add_column(_short_name(name.removesuffix("_planned")), justify="left" if name == "traffic" else "right")
    for cell in cells.to_dict("records"):
        means = [f"{cell[name]:.1f}{half_interval(cell[f'{name}_low'], cell[f'{name}_high'])}" for name in learned]
        means += [slots(cell[name]) for name in (*others, *planners)]
        means = [mean + censored(cell, name.removesuffix("_planned")) for mean, name in zip(means, shown, strict=True)]
        table.add_row(*axis_values(cell, axes), traffic_label(cell), *means)
    return table


def count_columns(counts: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Split one place's counts into columns: the best weights by their reward, then policies that are not trained."""
    labelled = counts.assign(traffic=[traffic_label(row) for row in counts.to_dict("records")])
    trained = labelled[labelled["policy"] == "best"]
    columns = {str(label): column for label, column in trained.groupby("traffic", sort=False)}
    for policy in dict.fromkeys(labelled["policy"]):
        if policy not in LEARNED:
            rows = labelled[labelled["policy"] == policy]
            # An untrained policy does not depend on the reward: take the rows of the first one.
            columns[_short_name(policy)] = rows[rows["traffic"] == rows["traffic"].iloc[0]]
    return columns


def count_table(counts: pd.DataFrame) -> Table:
    """Return the first failures in one place: devices down, policies across, the paper last; high traffic is bold."""
    columns = count_columns(counts)
    paper = TABLE7.get(str(counts["place"].iloc[0]))
    table = Table()
    for column in ("#", "weight", *columns, *(["paper"] if paper else [])):
        table.add_column(column, justify="right")
    devices = counts.drop_duplicates("device")
    for k, device in enumerate(devices.itertuples()):
        cells = [f"{column['count'].iloc[k]:.1f}" for column in columns.values()]
        row = [str(device.device), f"{device.weight:.2f}", *cells, *([str(paper[k])] if paper else [])]
        table.add_row(*row, style="bold" if device.high_traffic else None, end_section=k + 1 == len(devices))
    busy = devices["high_traffic"].to_numpy()
    totals = [f"{column['count'].to_numpy()[busy].sum():.1f}" for column in columns.values()]
    paper_total = sum(count for count, is_busy in zip(paper or (), busy, strict=False) if is_busy)
    table.add_row("high", "", *totals, *([str(paper_total)] if paper else []))
    return table


def claim_table(claims: pd.DataFrame) -> Table:
    """Return a table with one row per place, weights and traffic.

    Columns: shares of first failures, their paired difference, exact sign test, effect size, and the lifetime it costs.
    """
    table = Table()
    for column in ("place", "weights", "traffic"):
        table.add_column(column)
    for column in ("without", "with", "difference", "fewer/more/same", "exact p", "g", "slots"):
        table.add_column(column, justify="right", no_wrap=True)
    for _, row in claims.iterrows():
        style = "green" if row["difference"] < 0 else "red"
        table.add_row(
            row["place"],
            row["policy"],
            traffic_label(row),
            f"{row['share_without']:.0%}",
            f"{row['share']:.0%}",
            Text(
                f"{100 * row['difference']:+.0f}{half_interval(100 * row['low'], 100 * row['high'])}",
                style=style if row["p_value"] < _SIGNIFICANCE else "default",
            ),
            f"{row['fewer']}/{row['more']}/{row['same']}",
            f"{row['p_value']:.2g}",
            f"{row['g']:+.2f}",
            f"{row['slots']:+.1f}{half_interval(row['slots_low'], row['slots_high'])}",
        )
    return table

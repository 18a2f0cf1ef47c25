"""AgentIds fails first in an evacuation: the paper's Table 7 and studies like it."""

from typing import Any

import pandas as pd
from rich.table import Table
from rich.text import Text

from uavmec_jax.reporting.formatting import axis_values, half_interval
from uavmec_jax.studies.axes import TRAFFIC_WEIGHTS
from uavmec_jax.studies.first_failures import LEARNED, first_failure_groups, traffic_claims, with_traffic
from uavmec_jax.studies.paper import TABLE7
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.schema import PLANNERS

_SHORT = {
    "oldest_first": "oldest",
    "earliest_deadline": "deadline",
    "lowest_battery": "battery",
    "shortest_life": "life",
    "shortest_tour": "tour",
}
_SIGNIFICANT = 0.05


def traffic_words(cell: Any) -> str:
    """What traffic weighs in the reward of a cell: ``none``, ``visit 10`` (the paper's bonus), ``failure 100``, or both."""
    bonus, penalty = (float(cell[name]) for name in TRAFFIC_WEIGHTS)
    words = [f"visit {bonus:g}"] * (bonus > 0) + [f"failure {penalty:g}"] * (penalty > 0)
    return " + ".join(words) or "none"


def table7_tables(results: Results) -> dict[str, Table]:
    """First failures of each place's devices, lifetimes, and the test of the paper's claim."""
    shown = {"Lifetime in slots, mean over the seeds ± 95 %": lifetimes_table(results)}
    for name, counts in first_failure_groups(results).items():
        seeds = int(counts["seeds"].max())
        how = f"first failures of each device in {seeds} scenarios; best weights by what traffic weighs in their reward"
        shown[f"{name}: {how}"] = counts_table(counts)
    claims = traffic_claims(results)
    if len(claims):
        shown["First failures on devices in high traffic, with traffic in the reward against without, seed by seed"] = (
            claims_table(claims)
        )
    return shown


def lifetimes_table(results: Results) -> Table:
    """A line per cell: learned policies with their intervals, heuristics, planners."""
    cells, table = with_traffic(results.cells(), results.study), Table()
    axes = [axis for axis in cell_axes(results.study) if axis not in TRAFFIC_WEIGHTS]
    axes = [axis for axis in axes if cells[axis].nunique() > 1 or axis in ("powered", "connected")]
    learned = [name for name in LEARNED if name in cells]
    others = [name for name in results.policies if name not in LEARNED]
    planners = [f"{name}_planned" for name in PLANNERS if f"{name}_planned" in cells]
    for axis in axes:
        table.add_column(axis)
    for name in ("traffic", *learned, *others, *planners):
        shown = name.removesuffix("_planned")
        table.add_column(_SHORT.get(shown, shown.replace("_", "-")), justify="left" if name == "traffic" else "right")
    for cell in cells.to_dict("records"):
        intervals = [half_interval(cell[f"{name}_low"], cell[f"{name}_high"]) for name in learned]
        means = [f"{cell[name]:.1f}{half}" for name, half in zip(learned, intervals, strict=True)]
        means += [f"{cell[name]:.1f}" for name in (*others, *planners)]
        table.add_row(*axis_values(cell, axes), traffic_words(cell), *means)
    return table


def columns_of(counts: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Column title -> its rows of one place's counts: best weights by reward, then everyone who learns nothing."""
    named = counts.assign(traffic=[traffic_words(row) for row in counts.to_dict("records")])
    trained = named[named["policy"] == "best"]
    columns = {str(words): own for words, own in trained.groupby("traffic", sort=False)}
    for policy in dict.fromkeys(named["policy"]):
        if policy not in LEARNED:
            own = named[named["policy"] == policy]
            first = own[own["traffic"] == own["traffic"].iloc[0]]  # the same whatever a learner is paid for
            columns[_SHORT.get(policy, policy.replace("_", "-"))] = first
    return columns


def counts_table(counts: pd.DataFrame) -> Table:
    """One place: devices down, policies across, the paper last; those in high traffic are bold."""
    columns = columns_of(counts)
    paper = TABLE7.get(str(counts["place"].iloc[0]))
    table = Table()
    for name in ("#", "weight", *columns, *(["paper"] if paper else [])):
        table.add_column(name, justify="right")
    devices = counts.drop_duplicates("device")
    for k, device in enumerate(devices.itertuples()):
        cells = [f"{own['count'].iloc[k]:.1f}" for own in columns.values()]
        row = [str(device.device), f"{device.weight:.2f}", *cells, *([str(paper[k])] if paper else [])]
        table.add_row(*row, style="bold" if device.high_traffic else None, end_section=k + 1 == len(devices))
    busy = devices["high_traffic"].to_numpy()
    totals = [f"{own['count'].to_numpy()[busy].sum():.1f}" for own in columns.values()]
    ours = sum(count for count, high in zip(paper or (), busy, strict=False) if high)
    table.add_row("high", "", *totals, *([str(ours)] if paper else []))
    return table


def claims_table(claims: pd.DataFrame) -> Table:
    """A line per place, weights and traffic: shares, paired difference, exact sign test, effect, price in slots."""
    table = Table()
    for name in ("place", "weights", "traffic"):
        table.add_column(name)
    for name in ("without", "with", "difference", "fewer/more/same", "exact p", "g", "slots"):
        table.add_column(name, justify="right", no_wrap=True)
    for _, row in claims.iterrows():
        style = "green" if row["difference"] < 0 else "red"
        table.add_row(
            row["place"],
            row["policy"],
            traffic_words(row),
            f"{row['share_without']:.0%}",
            f"{row['share']:.0%}",
            Text(
                f"{100 * row['difference']:+.0f}{half_interval(100 * row['low'], 100 * row['high'])}",
                style=style if row["p_value"] < _SIGNIFICANT else "default",
            ),
            f"{row['fewer']}/{row['more']}/{row['same']}",
            f"{row['p_value']:.2g}",
            f"{row['g']:+.2f}",
            f"{row['slots']:+.1f}{half_interval(row['slots_low'], row['slots_high'])}",
        )
    return table

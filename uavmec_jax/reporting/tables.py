"""Tables of runs for the terminal, from results alone."""

from collections.abc import Callable
from typing import Any

import pandas as pd
from rich.table import Table
from rich.text import Text

from uavmec_jax.reporting.formatting import (
    axis_values,
    censored,
    column_name,
    first_to_fail,
    half_interval,
    is_censored,
    percent,
    slots,
)
from uavmec_jax.reporting.table6 import is_table6, table6_tables
from uavmec_jax.reporting.table7 import table7_tables
from uavmec_jax.studies.first_failures import has_places
from uavmec_jax.studies.paper import TABLE5
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.schema import Study

_NOTICEABLE_SLOTS = 0.5
"""Differences from the paper below this are not coloured: the paper rounds its numbers and averages few seeds."""


def is_grid(results: Results) -> bool:
    """Return whether the axes of a study are powered and connected devices and nothing else."""
    return cell_axes(results.study) == ["powered", "connected"]


def by_fleet(results: Results) -> dict[str, Results]:
    """Return the results of each fleet by the start of its titles; all of them, by an empty one, if fleets are no axis."""
    if not {"uavs", "depots"} & set(results.study.axes):
        return {"": results}
    return {_fleet_title(part.study): part for part in results.parts().values() if len(part.agents)}


def _fleet_title(study: Study) -> str:
    depots = len(study.used_depots)
    return f"{study.uavs} UAV{'s' * (study.uavs > 1)}, {depots} depot{'s' * (depots != 1)}: "


def tables(results: Results) -> dict[str, Table]:
    """Return the tables of a run by title: like Tables 5 to 7 where the study is like theirs, else a list of cells.

    There are none before the first shard is finished.
    """
    if not len(results.agents):
        return {}
    cells = results.cells()
    if has_places(results):
        return table7_tables(results)
    if is_table6(results):
        return table6_tables(cells)
    fleets = by_fleet(results)
    if not all(map(is_grid, fleets.values())):
        return {"Lifetime in slots, mean over the seeds ± 95 %": list_table(results, cells)}
    return {start + title: table for start, fleet in fleets.items() for title, table in _grid_tables(fleet).items()}


def _grid_tables(results: Results) -> dict[str, Table]:
    """The tables of a study like Table 5."""
    cells = results.cells()
    trained = [name for name in ("best", "last") if name in results.policies]
    compared = ["paper"] * _is_papers_fleet(results) + [column_name(name) for name in _baselines(results)]
    below = f"; below: {' / '.join(compared)}" if compared else ""
    titles: dict[str, str] = {name: f"Lifetime in slots, `{name}` weights ± 95 %{below}" for name in trained}
    if not trained and results.shown in results.policies:
        titles = {results.shown: f"Lifetime in slots, {display_name(results.shown)} ± 95 %{below}"}
    shown = {title: grid_table(results, cells, name) for name, title in titles.items()}
    if "best_over_oldest" in cells:
        shown["Slots more than oldest-first on the same layouts ± 95 %: `best`; below: `last`"] = paired_table(cells)
    if results.gaps:
        shown[gap_title(results)] = gap_table(results, cells)
    if f"{results.shown}_service" in cells:
        service = f"Share of the horizon in which devices are in service, {display_name(results.shown)}"
        shown[service] = _grid(cells, lambda cell: Text(f"{cell[f'{results.shown}_service']:.1%}"))
    first = f"First to fail ({display_name(results.shown)}): device, share of held-out episodes, all seeds"
    return shown | {first: failure_table(results, cells)}


def display_name(policy: str) -> str:
    """Return the name of a policy, as in the columns of results, in plain words."""
    names = {
        "best": "best weights",
        "last": "last weights",
        "rollout": "rollout planner",
        "beam": "clairvoyant beam",
        "bound": "upper bound",
    }
    return names.get(policy, column_name(policy))


def step_name(upper: str, lower: str) -> str:
    """Return the name of a step up to the upper bound."""
    return f"{display_name(lower)} to {display_name(upper)}"


def gap_title(results: Results) -> str:
    """Return the title of :func:`gap_table`: it names the lines of a cell."""
    steps = "; ".join(step_name(*step) for step in results.gaps)
    if any(f"{upper}_censored" in results.agents for upper, _ in results.gaps):
        steps += "; *: of the longer lifetimes, some are censored"
    return f"Gaps up to the upper bound, % (same layouts and volumes): {steps}"


def gap_table(results: Results, cells: pd.DataFrame) -> Table:
    """Return a grid of the steps from the shown policy up to the bound, each in percent of the lower lifetime."""

    def steps(cell: Any) -> Text:
        gaps = zip(results.gaps, gap_percent(results, cell).values(), strict=True)
        return Text("\n".join(percent(gap) + "*" * is_censored(cell, upper) for (upper, _), gap in gaps))

    return _grid(cells, steps)


def gap_percent(results: Results, cell: Any) -> dict[str, float]:
    """Return by how many percent each step raises the mean lifetime; a step is named like ``beam_over_rollout``.

    The lifetimes are those of the agents for which both ends of the step were evaluated, NaN without any.
    """
    agents = results.agents_of(cell)
    gaps = {}
    for upper, lower in results.gaps:
        both = agents.dropna(subset=[f"{upper}_planned", f"{lower}_planned"])
        gaps[f"{upper}_over_{lower}"] = 100 * (both[f"{upper}_planned"].mean() / both[f"{lower}_planned"].mean() - 1)
    return gaps


def grid_table(results: Results, cells: pd.DataFrame, policy: str) -> Table:
    """Return a grid of lifetimes in slots: ours ± half the 95 % interval; below, the paper's / those of baselines."""
    return _grid(cells, lambda cell: _lifetime(cell, policy, _baselines(results), _is_papers_fleet(results)))


def _baselines(results: Results) -> list[str]:
    """Return the policies that lifetimes are compared with in a grid."""
    return [name for name in ("oldest_first", "split_deadline") if name in results.policies]


def _is_papers_fleet(results: Results) -> bool:
    """Return whether the fleet of a study is the paper's: one UAV, no depot."""
    return results.study.uavs == 1 and not results.study.used_depots


def _lifetime(cell: Any, policy: str, baselines: list[str], with_paper: bool) -> Text:
    paper = TABLE5.get((cell["powered"], cell["connected"])) if with_paper else None
    mean = lambda name: f"{'≥' * is_censored(cell, name)}{cell[name]:.1f}"  # noqa: E731
    text = Text(mean(policy), style=_style(cell[policy], paper))
    text.append(half_interval(cell[f"{policy}_low"], cell[f"{policy}_high"]), style="dim")
    compared = [f"{paper:g}" if paper is not None else "-"] * with_paper
    compared += map(mean, baselines)
    separator = "\n" if f"{policy}_censored" in cell else "/"  # signs take room
    return text.append(f"\n{separator.join(compared)}" if compared else "", style="not bold default")


def _style(ours: float, paper: float | None) -> str:
    if paper is None or abs(ours - paper) < _NOTICEABLE_SLOTS:
        return "bold"
    return "bold green" if ours > paper else "bold red"


def paired_table(cells: pd.DataFrame) -> Table:
    """Return a grid of paired differences from oldest-first, coloured where the interval does not contain zero."""

    def difference(cell: Any, policy: str) -> Text:
        mean, low, high = (cell[f"{policy}_over_oldest{part}"] for part in ("", "_low", "_high"))
        style = "green" if low > 0 else "red" if high < 0 else "default"
        return Text(f"{mean:+.1f}", style=style).append(half_interval(low, high), style="dim")

    return _grid(cells, lambda cell: difference(cell, "best").append("\n").append(difference(cell, "last")))


def failure_table(results: Results, cells: pd.DataFrame) -> Table:
    """Return a grid of the device that fails first most often under the shown policy, and its share of the episodes."""
    policy = results.shown

    def first(cell: Any) -> Text:
        device = cell[f"{policy}_first_device"]
        text = Text(_first_to_fail(results, cell), style="bold" if device else "dim")
        return text.append(f" {cell[f'{policy}_first_share']:.0%}" * bool(device > 0), style="not bold dim")

    return _grid(cells, first)


def _first_to_fail(results: Results, cell: Any) -> str:
    """Format what fails first under the shown policy; ``none`` where nothing does before the time is over."""
    device = cell[f"{results.shown}_first_device"]
    in_time = results.study.params.end == "horizon" or cell.get(f"{results.shown}_censored", 0.0) == 1
    return "none" if device == 0 and in_time else first_to_fail(device)


def _grid(cells: pd.DataFrame, content: Callable[[Any], Text]) -> Table:
    """A table of powered x connected devices with a text for each cell; empty where an interrupted run has none."""
    table = Table()
    connected = list(dict.fromkeys(cells["connected"]))
    table.add_column("power\n\\ comms", justify="right", style="bold", no_wrap=True)
    for count in connected:
        table.add_column(str(count), justify="right", no_wrap=True)
    for powered in dict.fromkeys(cells["powered"]):
        row = cells[cells["powered"] == powered].set_index("connected", drop=False)
        texts = [content(row.loc[count]) if count in row.index else Text("") for count in connected]
        table.add_row(str(powered), *texts)
    return table


def list_table(results: Results, cells: pd.DataFrame) -> Table:
    """Return a table with one row per cell: every policy's mean lifetime, with an interval if it was trained."""
    axes = cell_axes(results.study)
    table = Table()
    for name in (*axes, "seeds"):
        table.add_column(name, justify="right")
    for policy in results.policies:
        table.add_column(column_name(policy), justify="right")
    served = [policy for policy in results.policies if f"{policy}_service" in cells]
    for policy in served:
        table.add_column(f"{column_name(policy)}, in service", justify="right")
    for upper, lower in results.gaps:
        table.add_column(f"{column_name(lower)} to {upper}, %", justify="right")
    drawn = results.study.scenarios is not None  # every draw is another scenario: device numbers mean nothing
    if not drawn:
        table.add_column("first to fail", justify="right")
    for _, cell in cells.iterrows():
        lifetimes = []
        for policy in results.policies:
            interval = (
                half_interval(cell[f"{policy}_low"], cell[f"{policy}_high"]) if policy in ("best", "last") else ""
            )
            lifetimes.append(f"{slots(cell[policy])}{interval}{censored(cell, policy)}")
        service = [f"{cell[f'{policy}_service']:.1%}" for policy in served]
        gaps = [percent(gap) for gap in gap_percent(results, cell).values()]
        failing = [] if drawn else [_first_to_fail(results, cell)]
        table.add_row(*axis_values(cell, (*axes, "seeds")), *lifetimes, *service, *gaps, *failing)
    return table

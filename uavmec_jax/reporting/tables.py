"""Tables of runs for the terminal, from results alone."""

from collections.abc import Callable
from typing import Any

import pandas as pd
from rich.table import Table
from rich.text import Text

from uavmec_jax.reporting.formatting import axis_values, column_name, first_to_fail, half_interval
from uavmec_jax.reporting.table6 import is_table6, table6_tables
from uavmec_jax.reporting.table7 import table7_tables
from uavmec_jax.studies.first_failures import has_places
from uavmec_jax.studies.paper import TABLE5
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.results import Results

_NOTICEABLE_SLOTS = 0.5
"""Differences from the paper below this are not coloured: the paper rounds its numbers and averages few seeds."""


def is_grid(results: Results) -> bool:
    """Return whether the axes of a study are powered and connected devices and nothing else."""
    return cell_axes(results.study) == ["powered", "connected"]


def tables(results: Results) -> dict[str, Table]:
    """Return the tables of a run by title: like Tables 5 to 7 where the study is like theirs, else a list of cells."""
    cells = results.cells()
    if has_places(results):
        return table7_tables(results)
    if is_table6(results):
        return table6_tables(cells)
    if not is_grid(results):
        return {"Lifetime in slots, mean over the seeds ± 95 %": list_table(results, cells)}
    return _grid_tables(results, cells)


def _grid_tables(results: Results, cells: pd.DataFrame) -> dict[str, Table]:
    """The tables of a study like Table 5."""
    trained = [name for name in ("best", "last") if name in results.policies]
    below = f"below: paper{' / oldest-first' * ('oldest_first' in results.policies)}"
    titles: dict[str, str] = {name: f"Lifetime in slots, `{name}` weights ± 95 %; {below}" for name in trained}
    if not trained and results.shown in results.policies:
        titles = {results.shown: f"Lifetime in slots, {display_name(results.shown)} ± 95 %; {below}"}
    shown = {title: grid_table(results, cells, name) for name, title in titles.items()}
    if "best_over_oldest" in cells:
        shown["Slots more than oldest-first on the same layouts ± 95 %: `best`; below: `last`"] = paired_table(cells)
    if results.gaps:
        shown[gap_title(results)] = gap_table(results, cells)
    first = f"First to fail ({display_name(results.shown)}): device, share of held-out episodes, all seeds"
    return shown | {first: failure_table(cells, results.shown)}


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


def gap_title(results: Results) -> str:
    """Return the title of :func:`gap_table`: it names the lines of a cell."""
    steps = "; ".join(_step(upper, lower) for upper, lower in results.gaps)
    return f"Gaps up to the upper bound, % (same layouts and volumes): {steps}"


def gap_table(results: Results, cells: pd.DataFrame) -> Table:
    """Return a grid of the steps from the shown policy up to the bound, each in percent of the lower lifetime."""
    return _grid(cells, lambda cell: Text("\n".join(f"{gap:+.1f}" for gap in gap_percent(results, cell).values())))


def gap_percent(results: Results, cell: Any) -> dict[str, float]:
    """Return by how many percent each step raises the mean lifetime; a step is named like ``beam_over_rollout``."""
    return {
        f"{upper}_over_{lower}": 100 * (cell[f"{upper}_planned"] / cell[f"{lower}_planned"] - 1)
        for upper, lower in results.gaps
    }


def grid_table(results: Results, cells: pd.DataFrame, policy: str) -> Table:
    """Return a grid of lifetimes in slots: ours ± half the 95 % interval; below, the paper's / oldest-first's."""
    baseline = "oldest_first" if "oldest_first" in results.policies else None
    return _grid(cells, lambda cell: _lifetime(cell, policy, baseline))


def _lifetime(cell: Any, policy: str, baseline: str | None) -> Text:
    paper = TABLE5.get((cell["powered"], cell["connected"]))
    text = Text(f"{cell[policy]:.1f}", style=_style(cell[policy], paper))
    text.append(half_interval(cell[f"{policy}_low"], cell[f"{policy}_high"]), style="dim")
    text.append(f"\n{paper:g}" if paper is not None else "\n-", style="not bold default")
    if baseline:
        text.append(f" / {cell[baseline]:.1f}", style="not bold default")
    return text


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


def failure_table(cells: pd.DataFrame, policy: str = "best") -> Table:
    """Return a grid of the device that fails first most often under a policy, and its share of the episodes."""

    def first(cell: Any) -> Text:
        device = cell[f"{policy}_first_device"]
        text = Text(first_to_fail(device), style="bold" if device else "dim")
        return text.append(f" {cell[f'{policy}_first_share']:.0%}" * bool(device), style="not bold dim")

    return _grid(cells, first)


def _grid(cells: pd.DataFrame, content: Callable[[Any], Text]) -> Table:
    """A table of powered x connected devices with a text for each cell; empty where an interrupted run has none."""
    table = Table()
    connected = list(dict.fromkeys(cells["connected"]))
    table.add_column("power\n\\ comms", justify="right", style="bold")
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
            lifetimes.append(f"{cell[policy]:.1f}{interval}")
        gaps = [f"{gap:+.1f}" for gap in gap_percent(results, cell).values()]
        failing = [] if drawn else [first_to_fail(cell[f"{results.shown}_first_device"])]
        table.add_row(*axis_values(cell, (*axes, "seeds")), *lifetimes, *gaps, *failing)
    return table


def _step(upper: str, lower: str) -> str:
    return f"{display_name(lower)} to {display_name(upper)}"


def summary(results: Results) -> list[str]:
    """Return the lines below the tables: overall means, gaps, and what the run cost."""
    cells, run = results.cells(), results.run
    means = ", ".join(f"{column_name(name)} {cells[name].mean():.2f}" for name in results.policies)
    lines = [f"Mean over {len(cells)} cells, slots: {means}."]
    if results.gaps:
        draws = results.evaluation[f"{results.gaps[0][0]}/lifetime"].shape[1]
        ladder = [results.gaps[0][1], *(upper for upper, _ in results.gaps)]
        means = ", ".join(f"{display_name(name)} {cells[f'{name}_planned'].mean():.2f}" for name in ladder)
        gaps = pd.DataFrame([gap_percent(results, cell) for _, cell in cells.iterrows()])
        steps = ", ".join(
            f"{_step(*pair)} {gaps[name].mean():.1f} (most {gaps[name].max():.1f})"
            for pair, name in zip(results.gaps, gaps, strict=True)
        )
        lines.append(f"On the planners' draws ({draws} per layout): {means}. Gaps, %, mean over the cells: {steps}.")
    if "training_steps_per_second" in run:
        seconds = run["seconds"]
        spent = ", ".join(
            f"{name} {seconds[name]:.0f} s"
            for name in ("compile", "train", "validate", "evaluate", "plan")
            if name in seconds
        )
        lines.append(
            f"{run['agents_done']} of {run['agents']} agents, {run['environment_steps']:,} environment steps at "
            f"{run['training_steps_per_second']:,}/s; {spent}, in all {seconds['wall']:.0f} s."
        )
    if run.get("diverged"):
        lines.append(f"{run['diverged']} agents diverged and were frozen; column diverged_at of agents.csv says when.")
    return lines

"""Tables for the terminal, from results alone."""

from typing import Any

import pandas as pd
from rich.table import Table
from rich.text import Text

from uavmec_jax.studies.paper import TABLE5
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.study import cell_axes

NOTICEABLE_SLOTS = 0.5
"""Differences from the paper below this many slots are not coloured: the paper rounds, and averages few seeds."""


def is_grid(results: Results) -> bool:
    """Whether the cells of a study are power x comms and nothing else."""
    return cell_axes(results.study) == ["powered", "connected"]


def tables(results: Results) -> dict[str, Table]:
    """The tables of a run by title: the paper's Table 5 where the study is such a grid, else a list of cells."""
    cells = results.cells()
    if not is_grid(results):
        return {"Lifetime in slots, mean over the seeds ± 95 %": list_table(results, cells)}
    below = f"below: paper{' / oldest-first' * ('oldest_first' in results.policies)}"
    shown = {
        f"Lifetime in slots, `best` weights ± 95 %; {below}": grid_table(results, cells, "best"),
        f"Lifetime in slots, `last` weights ± 95 %; {below}": grid_table(results, cells, "last"),
    }
    if "best_over_oldest" in cells:
        shown["Slots more than oldest-first on the same layouts ± 95 %: `best`; below: `last`"] = paired_table(cells)
    return shown | {"First to fail (best weights): device, share of held-out episodes, all seeds": failure_table(cells)}


def grid_table(results: Results, cells: pd.DataFrame, policy: str) -> Table:
    """Lifetimes in slots: ours +- half the 95 % interval, below it the paper's / oldest-first's."""
    baseline = "oldest_first" if "oldest_first" in results.policies else None
    return _grid(cells, lambda cell: _lifetime(cell, policy, baseline))


def _lifetime(cell: Any, policy: str, baseline: str | None) -> Text:
    paper = TABLE5.get((cell["powered"], cell["connected"]))
    text = Text(f"{cell[policy]:.1f}", style=_style(cell[policy], paper))
    text.append(_half(cell[f"{policy}_low"], cell[f"{policy}_high"]), style="dim")
    text.append(f"\n{paper:g}" if paper is not None else "\n-", style="not bold default")
    if baseline:
        text.append(f" / {cell[baseline]:.1f}", style="not bold default")
    return text


def _style(ours: float, paper: float | None) -> str:
    if paper is None or abs(ours - paper) < NOTICEABLE_SLOTS:
        return "bold"
    return "bold green" if ours > paper else "bold red"


def paired_table(cells: pd.DataFrame) -> Table:
    """Paired differences to oldest-first; coloured where the interval leaves out zero."""

    def difference(cell: Any, policy: str) -> Text:
        mean, low, high = (cell[f"{policy}_over_oldest{part}"] for part in ("", "_low", "_high"))
        style = "green" if low > 0 else "red" if high < 0 else "default"
        return Text(f"{mean:+.1f}", style=style).append(_half(low, high), style="dim")

    return _grid(cells, lambda cell: difference(cell, "best").append("\n").append(difference(cell, "last")))


def _half(low: float, high: float) -> str:
    """Half an interval as ±; ±? where there is none."""
    return f" ±{(high - low) / 2:.1f}" if high == high else " ±?"


def failure_table(cells: pd.DataFrame) -> Table:
    """The device that fails first most often under the best weights, and in what share of the episodes."""

    def first(cell: Any) -> Text:
        text = Text(_first(cell), style="bold" if cell["best_first_device"] else "dim")
        return text.append(f" {cell['best_first_share']:.0%}" * bool(cell["best_first_device"]), style="not bold dim")

    return _grid(cells, first)


def _first(cell: Any) -> str:
    return f"#{int(cell['best_first_device'])}" if cell["best_first_device"] else "UAV"


def _grid(cells: pd.DataFrame, content: Any) -> Table:
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
    """One line per cell: every policy's mean lifetime, the interval for the learned ones."""
    axes = cell_axes(results.study)
    table = Table()
    for name in (*axes, "seeds"):
        table.add_column(name, justify="right")
    for policy in results.policies:
        table.add_column(policy.replace("_", "-"), justify="right")
    table.add_column("first to fail", justify="right")
    for _, cell in cells.iterrows():
        lifetimes = []
        for policy in results.policies:
            interval = _half(cell[f"{policy}_low"], cell[f"{policy}_high"]) if policy in ("best", "last") else ""
            lifetimes.append(f"{cell[policy]:.1f}{interval}")
        place = [value if isinstance(value := cell[name], str) else f"{value:g}" for name in (*axes, "seeds")]
        table.add_row(*place, *lifetimes, _first(cell))
    return table


def summary(results: Results) -> list[str]:
    """A few lines below the tables: overall means and what the run cost."""
    cells, run = results.cells(), results.run
    means = ", ".join(f"{name.replace('_', '-')} {cells[name].mean():.2f}" for name in results.policies)
    lines = [f"Mean over {len(cells)} cells, slots: {means}."]
    if "training_steps_per_second" in run:
        seconds = run["seconds"]
        spent = ", ".join(f"{name} {seconds[name]:.0f} s" for name in ("compile", "train", "validate", "evaluate"))
        lines.append(
            f"{run['agents_done']} of {run['agents']} agents, {run['environment_steps']:,} environment steps at "
            f"{run['training_steps_per_second']:,}/s; {spent}, in all {seconds['wall']:.0f} s."
        )
    if run.get("diverged"):
        lines.append(f"{run['diverged']} agents diverged and were frozen; column diverged_at of agents.csv says when.")
    return lines

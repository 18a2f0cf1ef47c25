"""The lines below the tables of a run: overall means, gaps, and what the run cost."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from jaxtyping import Bool

from uavmec_jax.reporting.formatting import cell_name, column_name
from uavmec_jax.reporting.tables import by_fleet, display_name, gap_percent, step_name
from uavmec_jax.studies.measures import MOST_CENSORED, mostly_censored
from uavmec_jax.studies.population import cell_axes
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.results_files import LOST


def summary(results: Results) -> list[str]:
    """Return the lines below the tables: overall means and gaps, of each fleet by itself, and what the run cost."""
    lines = []
    for start, fleet in by_fleet(results).items() if len(results.agents) else ():
        lines += [start + line for line in (*_lifetime_lines(fleet), *_ladder_lines(fleet))]
    return lines + _cost_lines(results) + _missing_lines(results)


def _missing_lines(results: Results) -> list[str]:
    """Return what is not there: agents that are not finished, and facts that are lost."""
    run, lines = results.run, []
    if not run["complete"]:
        lines.append(f"{len(results.agents):,} of {run['agents']:,} agents are finished.")
    if LOST in run:
        lines.append(
            f"Not known, since {run[LOST]} is lost: what the run cost, and whether its files are as it wrote them."
        )
    return lines


def _lifetime_lines(results: Results) -> list[str]:
    """Return the means of the policies over the cells."""
    cells = results.cells()
    left_out = mostly_censored(cells, results.policies)
    kept = cells[~left_out]
    means = ", ".join(f"{column_name(name)} {kept[name].mean():.2f}" for name in results.policies)
    lines = [f"Mean over {len(kept)} cells, slots: {means}."] if len(kept) else []
    return lines + _left_out_lines(results, cells, left_out, results.policies)


def _ladder_lines(results: Results) -> list[str]:
    """Return the means of the shown policy, planners and bound on the planners' draws, and the gaps between them."""
    if not results.gaps:
        return []
    cells, ladder = results.cells(), results.ladder
    columns = [f"{name}_planned" for name in ladder]
    left_out = mostly_censored(cells, ladder)
    kept = [cell for _, cell in cells[~left_out].iterrows()]
    planned = pd.DataFrame([results.agents_of(cell)[columns].dropna().mean() for cell in kept])
    lines = []
    if kept:
        draws = results.evaluation[f"{results.gaps[0][0]}/lifetime"].shape[1]
        evaluated = len(results.agents.dropna(subset=columns))
        some = f", {evaluated} of {len(results.agents)} layouts" * (evaluated < len(results.agents))
        means = ", ".join(
            f"{display_name(name)} {planned[column].mean():.2f}" for name, column in zip(ladder, columns, strict=True)
        )
        gaps = pd.DataFrame([gap_percent(results, cell) for cell in kept])
        steps = ", ".join(
            f"{step_name(*pair)} {gaps[name].mean():.1f} (most {gaps[name].max():.1f})"
            for pair, name in zip(results.gaps, gaps, strict=True)
        )
        lines = [f"On the planners' draws ({draws} per layout{some}): {means}. Gaps, %, mean over the cells: {steps}."]
    return lines + _left_out_lines(results, cells, left_out, ladder)


def _left_out_lines(
    results: Results, cells: pd.DataFrame, left_out: Bool[np.ndarray, " C"], policies: Sequence[str]
) -> list[str]:
    """Name the cells that are left out of means over cells, with the policies that are mostly censored there."""
    if not left_out.any():
        return []
    names = []
    for _, cell in cells[left_out].iterrows():
        mostly = [policy for policy in policies if cell[f"{policy}_censored"] >= MOST_CENSORED]
        shares = ", ".join(f"{display_name(policy)} {cell[f'{policy}_censored']:.0%}" for policy in mostly)
        names.append(f"{cell_name(cell, cell_axes(results.study))} ({shares})")
    return [
        f"Left out of these means: {len(names)} of {len(cells)} cells, where half or more of the episodes of a policy are "
        f"censored (reach max_slots): {'; '.join(names)}."
    ]


def _cost_lines(results: Results) -> list[str]:
    """Return what training cost; nothing where nothing was trained."""
    run, lines = results.run, []
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

"""The figure of learners: their distance from the bound over seconds, and over steps."""

from pathlib import Path

import pandas as pd

from uavmec_jax.reporting.canvas import new_figure, save

PAPER_TRAINING_S = 660.0
"""The paper, section 5: a DQN's training takes about 11 minutes per scenario on its GPU."""
PAPER_SHARE = 0.87
"""What it reached: lifetimes of Table 5 as a share of our upper bound."""


def quality_figure(table: pd.DataFrame, path: Path) -> None:
    """Draw the share of the upper bound that each learner's present weights reach.

    Args:
        table: ``learner``, ``steps``, ``seconds`` of an agent, ``share`` and ``worst_cell``, one row per look.
        path: where the figure is written.
    """
    figure = new_figure(11.0, 4.6)
    left, right = figure.subplots(1, 2, sharey=True)
    for name, curve in table.groupby("learner", sort=False):
        (line,) = left.plot(curve["seconds"], 100 * curve["share"], label=name)
        right.plot(curve["steps"], 100 * curve["share"], color=line.get_color())
    left.plot([PAPER_TRAINING_S], [100 * PAPER_SHARE], "k*", label="the paper's DQN, as published")
    left.set_xscale("log")
    left.set_xlabel("seconds of the machine per agent")
    right.set_xlabel("environment steps of an agent")
    left.set_ylabel("last weights, % of the upper bound")
    for axis in (left, right):
        axis.set_ylim(60, 100.5)
        axis.grid(alpha=0.3)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    save(figure, path)

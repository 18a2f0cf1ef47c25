"""The paper's Table 6 from results."""

import io

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from uavmec_jax.reporting import canvas, figures
from uavmec_jax.reporting.table6 import is_table6, label_rewards
from uavmec_jax.reporting.tables import tables
from uavmec_jax.studies.population import make_agent_ids
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.study import load_study


@pytest.fixture(scope="module")
def results():
    """All agents of the shipped study with invented lifetimes: 21 to 25 slots for PPO on "A" in 8/8, 12 for the others."""
    study = load_study("table6")
    agents = pd.DataFrame(make_agent_ids(study))
    chosen = (agents.algorithm == "ppo") & (agents.reward == "A") & (agents.powered == 8)
    lifetime = np.where(chosen, 21.0 + agents.seed, 12.0)
    columns = {}
    for policy, behind in (("best", 0.0), ("last", 1.0), ("oldest_first", 2.0)):
        columns |= {f"{policy}_lifetime": lifetime - behind, f"{policy}_lifetime_fixed": lifetime - behind}
    share = np.zeros((len(agents), 2, 12), np.float32)
    evaluation = {f"{policy}/first_failure": share for policy in ("best", "last", "oldest_first")}
    curves = {"dqn": {"chunk_steps": np.arange(2)}}
    return Results(study=study, run={}, agents=agents.assign(**columns), curves=curves, evaluation=evaluation)


def test_each_pair_of_counts_is_a_table_like_the_papers(results):
    assert is_table6(results)
    shown = tables(results)
    titles = list(shown)
    assert [title.split(":")[0] for title in titles[:3]] == [
        "6 powered, 6 connected",
        "8 powered, 8 connected",
        "10 powered, 8 connected",
    ]
    table = shown[titles[1]]
    assert table.row_count == 15
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(table)
    text = console.export_text()
    for entry in ("23.0 ±1.2", "25.0 / 19", "22.0 ±1.2"):  # mean of 21 to 25, longest / paper's A, PPO, 8/8, last
        assert entry in text
    assert "12.0 / 28" in text  # the paper's DQN on U+log(A/O)
    assert "U+log(A/O)  (log1p)" in text


def test_rewards_under_a_second_guard_name_it(results):
    labels = label_rewards(results.cells())
    assert sum("(log1p)" in label for label in labels) == 4 * 9
    assert "A" in labels


def test_figure(results, tmp_path):
    canvas.save(figures.run_figure(results), tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 20_000


def test_an_interrupted_run_has_empty_entries(results):
    part = Results(
        study=results.study,
        run={},
        agents=results.agents.iloc[:250],
        curves=results.curves,
        evaluation={name: leaf[:250] for name, leaf in results.evaluation.items()},
    )
    assert [table.row_count for table in tables(part).values()] == [15, 15, 15, 3]
    assert figures.run_figure(part) is not None

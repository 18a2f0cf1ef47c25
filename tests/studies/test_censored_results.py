"""Results with censored episodes: one cell in which all is well, one that is half censored, one that is mostly censored."""

import io

import chex
import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rich.console import Console

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.reporting import canvas, figures
from uavmec_jax.reporting.compare import comparison
from uavmec_jax.reporting.summary import summary
from uavmec_jax.reporting.tables import gap_percent, tables
from uavmec_jax.runs.run_plan import label_of, plan_run
from uavmec_jax.studies import planner_evaluation
from uavmec_jax.studies.compare import Side, mostly_censored, overall, pair
from uavmec_jax.studies.evaluation_result import EvaluationResult, PlannerResult
from uavmec_jax.studies.measures import with_measures
from uavmec_jax.studies.population import (
    make_agent_ids,
)
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.results_files import read_results
from uavmec_jax.studies.shard_result import ShardResult
from uavmec_jax.studies.study import parse_study

CELLS = """
name = "made-up"
algorithm = "none"
[axes]
powered = [8, 6, 4]
connected = [8]
uavs = [2, 3]
seeds = 4
[params]
max_slots = 20
[evaluation]
draws = 2
planner_draws = 1
clairvoyant_seeds = [4, 4, 2]
baselines = ["oldest-first", "earliest-deadline"]
planners = ["rollout", "bound"]
"""


def made_up(text=CELLS):
    """Make results of policies that live 10, 20 and 20 slots in the three cells, and of planners one slot longer.

    With four powered devices, all episodes of earliest-deadline and of the rollout planner are censored; with six, those of
    seed 0. The bound is 15 and twice 20. With three UAVs it is missing for seeds 2 and 3.
    """
    study = parse_study(text, "made-up")
    ids = pd.DataFrame(make_agent_ids(study))
    lifetime = ids["powered"].map({8: 10, 6: 18, 4: 20}).to_numpy()
    censored = ((ids["powered"] == 4) | ((ids["powered"] == 6) & (ids["seed"] == 0))).to_numpy()
    lifetime = np.where(censored, 20, lifetime)
    cause = np.where(censored, Cause.NONE, Cause.BATTERY).astype(np.int8)
    first = np.where(censored[:, None], 0, np.eye(12, dtype=np.float32)[3])

    def policy(extra, draws):
        repeat = lambda values: np.repeat(values[:, None], draws, axis=1)  # noqa: E731
        longer = np.minimum(lifetime + extra, 20).astype(np.int32)
        return repeat(longer), repeat(cause), repeat(first.astype(np.float32))

    results = {"earliest-deadline": EvaluationResult(*policy(0, 3))}
    oldest = policy(-2, 3)
    results["oldest-first"] = EvaluationResult(oldest[0], np.full_like(oldest[1], Cause.DATA_AGE), oldest[2])
    known = ((ids["uavs"] == 2) | (ids["seed"] < 2)).to_numpy()
    bound = np.where(ids["powered"] == 8, 15, 20).astype(np.int32)[:, None]
    planners = {"rollout": PlannerResult(*policy(1, 1)), "bound": PlannerResult(bound[known]).at(known)}
    columns = {}
    for name, result in results.items():
        columns |= result.columns(name)
    columns |= planner_evaluation.planner_columns(results, planners)
    evaluation = {
        f"{name.replace('-', '_')}/{field}": array
        for name, result in (results | planners).items()
        for field, array in vars(result).items()
        if array is not None
    }
    shards = []
    for rows in np.split(np.arange(len(ids)), 2):  # as two shards
        table = ids.assign(**columns).iloc[rows].reset_index(drop=True)
        arrays = {name: array[rows] for name, array in evaluation.items()}
        shards.append(ShardResult("none", table, {}, arrays, {}, {"wall": 1.0}, 0))
    return Results.of(study, label_of(study, plan_run(study), "a test"), shards, len(ids))


@pytest.fixture(scope="module")
def results():
    return made_up()


def test_shares_of_censored_episodes(results):
    cells = results.cells().set_index(["powered", "uavs"])
    assert_allclose(cells["earliest_deadline_censored"], [0, 0.25, 1] * 2)
    assert_allclose(cells["rollout_censored"], [0, 0.25, 1] * 2)
    assert_allclose(cells["oldest_first_censored"], 0)
    assert_allclose(cells["bound_censored"], [0, 1, 1] * 2)
    bound = results.agents["bound_censored"]
    assert_array_equal(np.isnan(bound), np.isnan(results.agents["bound_planned"]))
    assert bound.isna().sum() == 3 * 2
    assert cells["bound_planned"].tolist() == [15, 20, 20] * 2


def test_without_a_censored_episode_there_is_no_column(results):
    fine = results.agents["powered"] == 8
    agents = results.agents[fine].reset_index(drop=True)
    agents = agents.drop(columns=[name for name in agents if name.endswith("_censored")])
    evaluation = {name: array[fine] for name, array in results.evaluation.items()}
    assert with_measures(results.study, agents, evaluation) is not agents
    pd.testing.assert_frame_equal(with_measures(results.study, agents, evaluation), agents)


def test_service_is_a_share_of_the_horizon():
    changes = {"params.end": "horizon", "params.horizon_s": 1000.0, "evaluation.planners": ["rollout"]}
    study = parse_study(CELLS, "x", changes)
    agents = pd.DataFrame({"seed": [0, 1]})
    cause = np.full((2, 3), Cause.HORIZON, np.int8)
    evaluation = {
        "last/lifetime": np.full((2, 3), 5),
        "last/cause": cause,
        "last/service_s": np.float32([[500, 700, 0], [1000, 1000, 0]]),
        "rollout/lifetime": np.full((2, 1), 5),
        "rollout/cause": cause[:, :1],
        "rollout/service_s": np.float32([[250], [np.nan]]),
    }
    table = with_measures(study, agents, evaluation)
    assert table.columns.tolist() == ["seed", "last_service", "rollout_service"]
    assert_allclose(table["last_service"], [0.6, 1])  # without the fixed draw, which comes last
    assert_allclose(table["rollout_service"], [0.25, np.nan])


def test_means_leave_out_cells_that_are_mostly_censored(results):
    lines = summary(results)
    assert lines[0] == "2 UAVs, 0 depots: Mean over 2 cells, slots: earliest-deadline 14.25, oldest-first 12.25."
    assert lines[1].startswith("2 UAVs, 0 depots: Left out of these means: 1 of 3 cells, where half or more of the")
    assert lines[1].endswith("censored (reach max_slots): 4/8 (earliest-deadline 100%).")
    assert "On the planners' draws (1 per layout): earliest-deadline 10.00, rollout planner 11.00, upper" in lines[2]
    assert "earliest-deadline to rollout planner 10.0 (most 10.0)" in lines[2]
    assert "2 of 3 cells, where" in lines[3]
    assert "6/8 (upper bound 100%); 4/8 (earliest-deadline 100%, rollout planner 100%, upper bound" in lines[3]
    assert lines[4].startswith("3 UAVs, 0 depots: Mean over 2 cells")
    assert "(1 per layout, 6 of 12 layouts)" in lines[6]


def test_gaps_are_between_the_same_agents():
    results = made_up()
    three = results.agents["uavs"] == 3
    results.agents.loc[three & (results.agents["seed"] >= 2), "rollout_planned"] = 1.0  # where there is no bound
    parts = results.parts()
    part = parts["none, uavs=3"]
    cell = part.cells().iloc[0]
    assert_allclose(gap_percent(part, cell)["bound_over_rollout"], 100 * (15 / 11 - 1))
    assert_allclose(cell["rollout_planned"], (11 + 1) / 2)
    assert_allclose(cell["bound_over_rollout"], 4)  # the paired difference too
    nothing = results.agents.assign(bound_planned=np.where(three, np.nan, 15.0))
    results = Results(results.study, results.run, nothing, {}, results.evaluation)
    assert results.parts()["none, uavs=3"].ladder == ["earliest_deadline", "rollout"]
    assert results.ladder == ["earliest_deadline", "rollout", "bound"]
    gaps = [gap_percent(results, cell)["bound_over_rollout"] for _, cell in results.cells().iterrows()]
    assert np.isnan(gaps).tolist() == [False] * 3 + [True] * 3
    assert tables(results)
    assert summary(results)


def text_of(shown):
    console = Console(file=io.StringIO(), width=200)
    for title, table in shown.items():
        console.print(title, table)
    return console.file.getvalue()


def test_tables_have_a_grid_for_each_fleet(results, tmp_path):
    shown = tables(results)
    assert [title.split(":")[0] for title in shown] == ["2 UAVs, 0 depots"] * 3 + ["3 UAVs, 0 depots"] * 3
    text = text_of(shown)
    assert "≥20.0 ±0.0" in text
    assert "│        2 │" not in text
    assert "│       4 │" in text  # no column is squeezed out
    assert "paper" not in text
    assert "nan" not in text
    canvas.save(figures.run_figure(results), tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000
    speeds = made_up(CELLS.replace("seeds = 4", "uav_speed_m_s = [5.0, 6.0]\nseeds = 4"))
    (table,) = tables(speeds).values()
    assert table.row_count == 12
    assert "(25% censored)" in text_of({"": table})
    assert figures.run_figure(speeds)


def test_episodes_that_were_not_evaluated_are_no_rows(results):
    episodes = results.episode_table()
    assert (episodes["lifetime"] > 0).all()
    bound = episodes[episodes["policy"] == "bound"]
    assert bound.groupby("uavs").size().tolist() == [12, 6]


def test_files_read_back(results, tmp_path):
    results.save(tmp_path)
    again = read_results(tmp_path)
    pd.testing.assert_frame_equal(again.agents, results.agents, check_dtype=False)
    pd.testing.assert_frame_equal(again.cells(), results.cells(), check_dtype=False)
    chex.assert_trees_all_equal(again.evaluation, results.evaluation)
    assert summary(again) == summary(results)


def test_comparisons_leave_out_cells_that_are_mostly_censored(results):
    a, b = (Side(results, "earliest-deadline", {"uavs": uavs}) for uavs in (2, 3))
    both, cells = pair(a, b)
    assert {"censored_a", "censored_b"} <= set(both)
    assert mostly_censored(both, cells).sum() == 4
    others = both[both["powered"] != 4]
    assert overall(both, cells) == overall(others, cells)
    shown, data = comparison(a, b)
    assert data["left_out"] == ["4/8"]
    assert any(title.startswith("Over 2 of 3 cells, 8 pairs; half or more") for title in shown)
    assert "20.00 (100% censored)" in text_of(shown)
    only = both[both["powered"] == 4]
    assert np.isnan(overall(only, cells)["difference"]).all()
    plain, _ = pair(*(Side(results, "earliest-deadline", {"uavs": uavs, "powered": 8}) for uavs in (2, 3)))
    assert not any(name.startswith("censored") for name in plain)

"""Whole runs: the files that they leave, and that these can be read back."""

import json
import shutil

import chex
import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal

from uavmec_jax.errors import PolicyError, StudyError
from uavmec_jax.files.output_folders import check_directory
from uavmec_jax.reporting import canvas, figures, tables
from uavmec_jax.reporting.summary import summary
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.runs.run import resume_run, run_study
from uavmec_jax.runs.run_plan import BYTES_WITHOUT_TRAINING, plan_run
from uavmec_jax.studies.results_files import load_weights
from uavmec_jax.studies.study import parse_study
from uavmec_jax.training import host
from uavmec_jax.training.training import Trainer

TOML = """
name = "tiny"
steps = 600
[axes]
powered = [12, 4]
connected = [12, 4]
seeds = 2
[evaluation]
draws = 5
validate_every = 200
validation_draws = 3
planner_draws = 2
beam_width = 8
baselines = ["stay-put", "random", "round-robin", "oldest-first", "earliest-deadline"]
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    directory = tmp_path_factory.mktemp("runs") / "täst run"
    return run_study(parse_study(TOML, "tiny"), directory, command="uavmec run tiny.toml"), directory


def test_files_of_a_run(finished):
    _, directory = finished
    names = {file.name for file in directory.iterdir()}
    assert names == {
        "study.toml",
        "run.json",
        "agents.csv",
        "curves.npz",
        "evaluation.npz",
        "weights.npz",
        "run_plan.json",
        "log",
    }
    run = json.loads((directory / "run.json").read_text())
    assert run["complete"]
    assert run["command"] == "uavmec run tiny.toml"
    assert run["seeds"] == [0, 1]
    assert run["environment_steps"] == 8 * 600
    assert run["schema"] == 3
    assert run["partitions"]["dqn"].keys() == {"shards", "shard_size", "groups", "shard_bytes"}
    assert run["versions"]["jax"]
    assert run["training_steps_per_second"] > 0


def test_tidy_table_has_one_row_per_agent(finished):
    _, directory = finished
    agents = pd.read_csv(directory / "agents.csv")
    assert len(agents) == 8
    assert agents.columns[:3].tolist() == ["seed", "powered", "connected"]
    for policy in ("best", "last", "stay_put", "random", "round_robin", "oldest_first", "earliest_deadline"):
        assert agents[f"{policy}_lifetime"].between(5, 40).all()
        assert set(agents[f"{policy}_cause"]) <= {"battery", "data_age", "uav"}
    rich = agents[(agents.powered == 12) & (agents.connected == 12)]
    assert (rich["stay_put_lifetime"] == 33).all()
    assert (rich["stay_put_cause"] == "uav").all()
    assert (rich["stay_put_first_device"] == 0).all()


def test_read_back_equals_what_was_run(finished):
    results, directory = finished
    again = load_results(directory)
    assert again.study == results.study
    pd.testing.assert_frame_equal(again.agents, results.agents, check_dtype=False, rtol=1e-5)
    chex.assert_trees_all_equal((again.curves, again.evaluation), (results.curves, results.evaluation))
    assert results.curves["dqn"]["validation"].shape == (8, 3)
    assert results.evaluation["best/lifetime"].shape == (8, 6)
    kernel = load_weights(directory)["params"]["TorchDense_0"]["kernel"]
    assert_array_equal(kernel, results.weights["dqn/best/params/TorchDense_0/kernel"])
    with pytest.raises(PolicyError, match="there are no 'worst' weights of 'dqn'; there are best and last of dqn"):
        load_weights(directory, "worst")


def test_cells_are_means_over_seeds(finished):
    results, _ = finished
    cells = results.cells()
    assert len(cells) == 4
    cell = cells[(cells.powered == 4) & (cells.connected == 12)].iloc[0]
    values = results.agents.query("powered == 4 and connected == 12")["best_lifetime"]
    assert cell["best"] == values.mean()
    assert cell["best_low"] <= cell["best"] <= cell["best_high"]
    paired = values - results.agents.query("powered == 4 and connected == 12")["oldest_first_lifetime"]
    assert cell["best_over_oldest"] == paired.mean()
    share = results.first_failures("best")
    assert share.shape == (8, 12)
    assert ((share.sum(axis=1) < 1.0001) & (share >= 0).all(axis=1)).all()


def test_tables_and_figures(finished, tmp_path):
    results, _ = finished
    shown = tables.tables(results)
    assert len(shown) == 5
    assert any(
        "best weights to rollout planner; rollout planner to clairvoyant beam; clair" in title for title in shown
    )
    lines = summary(results)
    assert "Mean over 4 cells" in lines[0]
    assert "On the planners' draws (2 per layout): best weights" in lines[1]
    for figure in (figures.run_figure(results), figures.curves_figure(results), figures.ladder_figure(results)):
        canvas.save(figure, tmp_path / "figure.png")
        assert (tmp_path / "figure.png").stat().st_size > 10_000


@pytest.mark.slow
def test_other_axes_make_a_list():
    study = parse_study(TOML, "tiny", {"axes.gamma": [0.9, 0.98], "axes.powered": [8], "axes.seeds": 1})
    results = run_study(study)
    assert len(results.cells()) == 4
    (table,) = tables.tables(results).values()
    assert table.row_count == 4
    assert summary(results)
    assert figures.run_figure(results)


def test_planners_play_the_same_draws_and_the_bound_holds(finished):
    results, _ = finished
    bound = results.evaluation["bound/lifetime"]
    assert bound.shape == results.evaluation["rollout/lifetime"].shape == (8, 2)
    for policy in (*results.policies, "rollout", "beam"):
        lifetimes = results.evaluation[f"{policy}/lifetime"][:, :2]
        assert (lifetimes <= bound).all(), policy
        assert_array_equal(results.agents[f"{policy}_planned"], lifetimes.mean(axis=1))
    assert results.gaps == [("rollout", "best"), ("beam", "rollout"), ("bound", "beam")]
    cells = results.cells()
    difference = results.agents["beam_planned"] - results.agents["rollout_planned"]
    assert cells["beam_over_rollout"].mean() == pytest.approx(difference.mean())
    assert (cells["rollout_over_best_low"] <= cells["rollout_over_best_high"]).all()
    for _, cell in cells.iterrows():
        percent = tables.gap_percent(results, cell)["bound_over_beam"]
        assert percent == pytest.approx(100 * (cell["bound_planned"] / cell["beam_planned"] - 1))
    # Staying put is optimal if every device is powered and connected, and the planners find it.
    rich = results.agents.query("powered == 12 and connected == 12")
    assert (rich["beam_planned"] >= 33).all()


@pytest.mark.slow
def test_a_study_that_trains_nothing(tmp_path):
    changes = {"algorithm": "none", "axes.powered": [8], "evaluation.planners": ["bound"], "evaluation.draws": 3}
    study = parse_study(TOML, "tiny", changes | {"evaluation.baselines": ["oldest-first", "earliest-deadline"]})
    results = run_study(study, tmp_path / "none")
    assert results.run["complete"]
    assert results.policies == ["oldest_first", "earliest_deadline"]
    assert results.shown == "earliest_deadline"
    assert results.gaps == [("bound", "earliest_deadline")]
    assert {file.name for file in (tmp_path / "none").iterdir()} == {
        "study.toml",
        "run.json",
        "agents.csv",
        "evaluation.npz",
        "run_plan.json",
        "log",
    }
    again = load_results(tmp_path / "none")
    assert_array_equal(again.evaluation["bound/lifetime"], results.evaluation["bound/lifetime"])
    assert len(tables.tables(again)) == 3
    assert "upper bound" in summary(again)[1]
    assert figures.run_figure(again)


@pytest.mark.slow
@pytest.mark.parametrize("powered", [[8, 4], [8]])
def test_the_figure_of_heuristics_alone(powered):
    changes = {"algorithm": "none", "evaluation.planners": [], "evaluation.baselines": ["random"]}
    for axes in ({"axes.powered": powered}, {"axes.powered": powered, "axes.uav_speed_m_s": [5.0, 9.0]}):
        assert figures.run_figure(run_study(parse_study(TOML, "tiny", changes | axes)))


compile_trainer = Trainer.compile


def leave_room_for(agents, study, monkeypatch):
    """Pretend that the host has memory for so many agents in training."""
    plan = plan_run(study)
    partition = plan.partitions["dqn"]
    free = BYTES_WITHOUT_TRAINING * plan.agents + agents * partition.shard_bytes // partition.shard_size
    monkeypatch.setattr(host, "free_memory", lambda: free)


@pytest.mark.slow
def test_shards_one_after_the_other_give_every_agent_once_and_compile_once(finished, monkeypatch):
    study = finished[0].study
    study = study.model_copy(update={"evaluation": study.evaluation.model_copy(update={"planners": ()})})
    leave_room_for(2, study, monkeypatch)
    assert len(plan_run(study).shards) == 4
    compiled = []
    monkeypatch.setattr(
        Trainer, "compile", lambda *arguments: compiled.append(arguments) or compile_trainer(*arguments)
    )
    results = run_study(study)
    assert len(compiled) == 1
    assert results.run["complete"]
    pd.testing.assert_frame_equal(results.agents.iloc[:, :3], finished[0].agents.iloc[:, :3])
    assert_array_equal(results.evaluation["oldest_first/lifetime"], finished[0].evaluation["oldest_first/lifetime"])
    assert results.curves["dqn"]["validation"].shape == (8, 3)


@pytest.mark.slow
def test_an_interrupted_run_keeps_the_finished_shards(finished, monkeypatch, tmp_path):
    study = parse_study(TOML, "tiny", {"evaluation.planners": [], "evaluation.baselines": []})
    leave_room_for(4, study, monkeypatch)
    assert len(plan_run(study).shards) == 2

    def interrupt(progress):
        if progress.shard == 1:
            raise KeyboardInterrupt

    results = run_study(study, tmp_path / "half", on_progress=interrupt)
    assert not results.run["complete"]
    assert len(load_results(tmp_path / "half").agents) == 4


def test_run_that_does_not_fit_is_refused_before_anything_is_written(finished, monkeypatch, tmp_path):
    with pytest.raises(StudyError, match=r"tiny: steps is 2000000000: one agent needs"):
        run_study(parse_study(TOML, "tiny", {"steps": 2 * 10**9, "dqn.replay_capacity": 2 * 10**9}), tmp_path / "big")
    with pytest.raises(StudyError, match=r"8,000,000,000 agents need .* GiB of memory, and as much disk"):
        plan_run(parse_study(TOML, "tiny", {"axes.seeds": 2 * 10**9}))
    assert not (tmp_path / "big").exists()


def test_folder_that_is_taken_is_refused(finished, tmp_path):
    _, directory = finished
    with pytest.raises(StudyError, match="already holds a run"):
        check_directory(directory)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(StudyError, match="not an empty folder"):
        check_directory(tmp_path)
    check_directory(tmp_path / "new")


def damage(directory, tmp_path, name, content):
    copy = tmp_path / "copy"
    shutil.copytree(directory, copy)
    (copy / name).write_bytes(content((directory / name).read_bytes()))
    return copy


@pytest.mark.parametrize("name", ["run.json", "curves.npz", "evaluation.npz", "study.toml"])
def test_damaged_file_is_named(finished, tmp_path, name):
    copy = damage(finished[1], tmp_path, name, lambda data: data[: len(data) // 2])
    with pytest.raises(StudyError, match=r"cannot be read|not TOML|not JSON|is missing|study.toml: params"):
        load_results(copy)


def test_flipped_bit_in_the_weights_is_found(finished, tmp_path):
    def flip(data):
        middle = len(data) // 2
        return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]

    with pytest.raises(PolicyError, match=r"weights.npz: cannot be read"):
        load_weights(damage(finished[1], tmp_path, "weights.npz", flip))


@pytest.mark.parametrize("schema", [1, 2, 4, 99])
def test_another_schema_is_refused(finished, tmp_path, schema):
    def change(data):
        return data.replace(b'"schema": 3', f'"schema": {schema}'.encode())

    with pytest.raises(StudyError, match=rf"run.json: schema is {schema}; this version reads 3$"):
        load_results(damage(finished[1], tmp_path, "run.json", change))


def test_stopped_and_resumed_the_results_are_equal_to_the_bit(finished, tmp_path):
    results, directory = finished

    def stop(progress):
        if progress.steps >= 8 * 300:
            raise KeyboardInterrupt

    half = run_study(results.study, tmp_path / "half", on_progress=stop)
    assert (half.run["complete"], half.run["stopped_by"], len(half.agents)) == (False, 2, 0)
    events = []
    again = resume_run(tmp_path / "half", on_event=lambda event, facts: events.append((event, facts)))
    assert [facts["steps"] for event, facts in events if event == "restored"] == [300]
    for name in ("agents.csv", "curves.npz", "evaluation.npz", "weights.npz"):
        assert (tmp_path / "half" / name).read_bytes() == (directory / name).read_bytes()
    assert np.isfinite(again.agents["best_lifetime"]).all()

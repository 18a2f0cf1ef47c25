"""The experiments with Q-learners run, at small sizes."""

import json

import device_profile
import pandas as pd
import pytest

from tests.experiments.scripts import run
from uavmec_jax.runs.run import run_study
from uavmec_jax.studies.study import load_study


@pytest.mark.full
def test_ablation(tmp_path):
    options = ("--steps", 2048, "--seeds", 1, "--variants", "no gap", "--runs", tmp_path / "runs", "--out", tmp_path)
    assert "no gap" in run("q_ablation.py", *options)
    table = pd.read_csv(tmp_path / "ablation.csv").iloc[0]
    assert 20 < table["worst_cell"] <= table["last"] < 100
    assert table["last_low"] <= table["last"] <= table["last_high"]


@pytest.mark.full
def test_time_to_quality(tmp_path):
    learner = "PQN (table5-best)"
    options = ("--steps", 4096, "--every", 2048, "--seeds", 1, "--learners", learner, "--no-sb3", "--out", tmp_path)
    earlier = pd.DataFrame(
        {"learner": ["another", learner], "agents": 25, "steps": 1, "seconds": 1.0, "share": 0.5, "worst_cell": 0.4}
    )
    earlier.to_csv(tmp_path / "time_to_quality.csv", index=False)
    run("time_to_quality.py", *options)
    table = pd.read_csv(tmp_path / "time_to_quality.csv")
    assert table["learner"].tolist() == ["another", learner, learner]  # the one that is not measured keeps its row
    curve = table[table["learner"] == learner]
    assert curve["steps"].tolist() == [2048, 4096]
    assert curve["seconds"].is_monotonic_increasing
    assert ((curve["share"] > 0.2) & (curve["share"] < 1)).all()
    report = json.loads((tmp_path / "time_to_quality.json").read_text())["learners"][learner]
    assert report["agents"] == 25
    assert report["last"]["share"] == pytest.approx(curve["share"].iloc[-1], rel=1e-3)
    assert (tmp_path / "time_to_quality.png").stat().st_size > 10_000


@pytest.mark.full
def test_learning_curves(tmp_path):
    small = {
        "axes.powered": [8],
        "axes.connected": [8],
        "axes.seeds": 2,
        "steps": 4096,
        "evaluation.validate_every": 2048,
    }
    for study in ("table5", "table5-best-dqn", "table5-best"):
        run_study(load_study(study, small | {"evaluation.planner_draws": 1}), tmp_path / study)
    run("learning_curves.py", "--results", tmp_path, "--out", tmp_path)
    assert (tmp_path / "learning_curves.png").stat().st_size > 10_000


def test_summary_of_a_profile():
    iterations = device_profile.ITERATIONS
    events = [("gemm", 10.0 * k, 2.0) for k in range(iterations)] + [
        ("add", 10.0 * k + 5, 1.0) for k in range(iterations)
    ]
    summary = device_profile.summarize(events, longest=1)
    assert summary["kernels_per_iteration"] == 2.0
    assert summary["busy_share"] == pytest.approx(3 * iterations / (10 * iterations - 4), abs=1e-3)
    (longest,) = summary["longest"]
    assert (longest["kernel"], longest["share"], longest["per_iteration"]) == (
        "gemm",
        pytest.approx(2 / 3, abs=1e-3),
        1.0,
    )
    assert device_profile.summarize([])["longest"] == []

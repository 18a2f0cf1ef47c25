"""The benchmarks run, at small sizes."""

import json

import pytest

from tests.experiments.scripts import run

pytestmark = pytest.mark.full


def test_benchmark_on_policy(tmp_path):
    run("benchmark_on_policy.py", "--seconds", 0.1, "--agents", 2, "--out", tmp_path)
    report = json.loads((tmp_path / "benchmark_on_policy.json").read_text())
    rows = [(row["algorithm"], row["agents"], row["n_envs"]) for row in report["training"]]
    assert rows == [("ppo", 2, 1), ("ppo", 8, 16), ("a2c", 2, 1), ("a2c", 8, 16)]
    assert all(row["steps_per_second"] > 0 for row in report["training"])


def test_benchmark_dqn(tmp_path):
    out = run("benchmark_dqn.py", "--seconds", 0.3, "--agents", 1, 8, "--out", tmp_path)
    assert "environment alone" in out
    report = json.loads((tmp_path / "benchmark_dqn.json").read_text())
    assert [row["agents"] for row in report["training"]] == [1, 8]
    assert all(row["steps_per_second"] > 0 for row in report["training"])
    assert report["ceiling"] > 0


def test_benchmark_planning(tmp_path):
    out = run("benchmark_planning.py", "--layouts", 3, "--widths", 8, "--out", tmp_path)
    assert "beam 8" in out
    rows = json.loads((tmp_path / "benchmark_planning.json").read_text())["rows"]
    assert len(rows) == 4 * 3
    means = {(row["powered"], row["planner"]): row["mean"] for row in rows}
    assert all(means[powered, "beam 8"] <= means[powered, "bound"] for powered in (12, 10, 8, 4))


def test_benchmark_accelerator(tmp_path):
    out = run("benchmark_accelerator.py", "--quick", "--seconds", 0.2, "--out", tmp_path)
    assert "table5: 25 agents" in out
    report = json.loads((tmp_path / "throughput.json").read_text())
    assert [row["layouts"] for row in report["environment"]] == [1000]
    assert report["training"][0]["steps_per_second"] > 0


def test_simulation_against_a_run(tmp_path):
    settings = (
        "algorithm=none",
        "axes.seeds=1",
        "axes.powered=[8]",
        "evaluation.draws=2",
        "evaluation.planner_draws=2",
    )
    settings = (*settings, "evaluation.planners=[]")
    options = ["--study", "planning", *(part for setting in settings for part in ("--set", setting))]
    out = run("simulation_against_a_run.py", *options, "--out", tmp_path / "run")
    assert "wall time" in out
    report = json.loads((tmp_path / "run" / "simulation.json").read_text())
    assert set(report["measured"]) == {"wall_s", "disk_bytes", "memory_bytes"}

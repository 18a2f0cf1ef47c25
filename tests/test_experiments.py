"""The experiment scripts run from the clone, small."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

EXPERIMENTS = Path(__file__).parents[1] / "experiments"

pytestmark = pytest.mark.slow


def run(script, *arguments):
    done = subprocess.run(
        [sys.executable, EXPERIMENTS / script, *map(str, arguments)], capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_table5_grid(tmp_path):
    out = run("table5_grid.py", "--seeds", 1, "--steps", 400, "--out", tmp_path / "grid")
    assert "Lifetime in slots" in out
    assert (tmp_path / "grid" / "figure.png").exists()


def test_table6_rewards(tmp_path):
    out = run("table6_rewards.py", "--seeds", 1, "--steps", 400, "--out", tmp_path / "table6")
    assert "8 powered, 8 connected: lifetime in slots" in out
    assert (tmp_path / "table6" / "figure.png").exists()


def test_benchmark_on_policy(tmp_path):
    run("benchmark_on_policy.py", "--seconds", 0.1, "--agents", 2, "--out", tmp_path)
    report = json.loads((tmp_path / "benchmark_on_policy.json").read_text())
    found = [(row["algorithm"], row["agents"], row["n_envs"]) for row in report["training"]]
    assert found == [("ppo", 2, 1), ("ppo", 8, 16), ("a2c", 2, 1), ("a2c", 8, 16)]
    assert all(row["steps_per_second"] > 0 for row in report["training"])


def test_figure3_training(tmp_path):
    run("figure3_training.py", "--steps", 60_000, "--out", tmp_path)
    assert (tmp_path / "figure3.png").stat().st_size > 20_000
    assert {folder.name for folder in tmp_path.iterdir() if folder.is_dir()} == {"learning-rates", "short", "seeds"}


def test_benchmark_dqn(tmp_path):
    out = run("benchmark_dqn.py", "--seconds", 0.3, "--out", tmp_path)
    assert "environment alone" in out
    report = json.loads((tmp_path / "benchmark_dqn.json").read_text())
    assert [row["agents"] for row in report["training"]] == [1, 8, 75, 300]
    assert all(row["steps_per_second"] > 0 for row in report["training"])
    assert report["ceiling"] > 0


def test_benchmark_planning(tmp_path):
    out = run("benchmark_planning.py", "--layouts", 3, "--widths", 8, "--out", tmp_path)
    assert "beam 8" in out
    rows = json.loads((tmp_path / "benchmark_planning.json").read_text())["rows"]
    assert len(rows) == 4 * 3
    means = {(row["powered"], row["planner"]): row["mean"] for row in rows}
    assert all(means[powered, "beam 8"] <= means[powered, "bound"] for powered in (12, 10, 8, 4))


def test_table7_evacuation(tmp_path):
    out = run("table7_evacuation.py", "--seeds", 1, "--steps", 400, "--out", tmp_path / "table7")
    assert "round_lake: first failures of each device" in out
    assert (tmp_path / "table7" / "figure.png").exists()
    pictures = {file.name for file in (tmp_path / "table7-pictures").iterdir()}
    assert pictures == {"round_lake.png", "round_lake.gif", "albany.png", "albany.gif"}


def test_benchmark_accelerator(tmp_path):
    out = run("benchmark_accelerator.py", "--quick", "--seconds", 0.2, "--out", tmp_path)
    assert "table5: 25 agents" in out
    report = json.loads((tmp_path / "throughput.json").read_text())
    assert [row["layouts"] for row in report["environment"]] == [1000]
    assert report["training"][0]["steps_per_second"] > 0


def test_simulation_against_a_run(tmp_path):
    settings = ("algorithm=none", "axes.seeds=1", "axes.powered=[8]", "evaluation.draws=2", "evaluation.planners=[]")
    options = ["--study", "planning", *(part for one in settings for part in ("--set", one))]
    out = run("simulation_against_a_run.py", *options, "--out", tmp_path / "run")
    assert "wall time" in out
    report = json.loads((tmp_path / "run" / "simulation.json").read_text())
    assert set(report["measured"]) == {"wall_s", "disk_bytes", "memory_bytes"}


def test_generalist_training(tmp_path):
    run("generalist_training.py", "--scenarios", 8, "--epochs", 1, "--steps", 16_384, "--towns", 1, "--out", tmp_path)
    report = json.loads((tmp_path / "training.json").read_text())
    assert len(report["ppo"]["slots"]) == len(report["ppo"]["seconds"]) == 1
    assert report["imitation_then_ppo"]["seconds"][0] > report["beam"]["seconds"]
    assert report["lines"]["oldest_first"] < report["lines"]["bound"]
    assert (tmp_path / "training.png").stat().st_size > 20_000


def test_generalist_planners(tmp_path):
    run("generalist_planners.py", "--towns", 1, "--widths", 2, "--out", tmp_path)
    report = json.loads((tmp_path / "planners.json").read_text())
    assert report["episodes"] == 25
    assert set(report["mean_slots"]) == set(report["seconds"])
    assert report["mean_slots"]["generalist"] > 20


def test_generalist_elsewhere_and_speed(tmp_path):
    out = run("generalist_elsewhere.py", "--towns", 2, "--draws", 1, "--out", tmp_path)
    assert "48 devices" in out
    assert "random weights" in out
    assert (tmp_path / "traffic.png").exists()
    run("generalist_speed.py", "--scenarios", 256, "--repetitions", 3, "--out", tmp_path)
    rows = json.loads((tmp_path / "speed.json").read_text())["policies"]
    assert all(row["decisions_per_second"] > 0 for row in rows.values())


def test_ship_generalist(tmp_path):
    out = run("ship_generalist.py", "--run", tmp_path / "run", "--into", tmp_path / "mine.npz", "--steps", 16_384)
    assert "mine.npz" in out
    from uavmec_jax.studies.policies import load_policy

    assert load_policy(tmp_path / "mine.npz").n_devices is None

"""The scripts about the generalist run, at small sizes."""

import json

import pytest

from tests.experiments.scripts import run
from uavmec_jax.scenarios.policies import load_policy

pytestmark = pytest.mark.full


def test_generalist_training(tmp_path):
    run("generalist_training.py", "--scenarios", 8, "--epochs", 1, "--steps", 16_384, "--layouts", 1, "--out", tmp_path)
    report = json.loads((tmp_path / "training.json").read_text())
    assert len(report["ppo"]["slots"]) == len(report["ppo"]["seconds"]) == 1
    assert report["imitation_then_ppo"]["seconds"][0] > report["beam"]["seconds"]
    assert report["lines"]["oldest_first"] < report["lines"]["bound"]
    assert (tmp_path / "training.png").stat().st_size > 20_000


def test_generalist_grid(tmp_path):
    run("generalist_grid.py", "--layouts", 1, "--samples", 4, "--out", tmp_path)
    report = json.loads((tmp_path / "grid.json").read_text())
    assert report["first_failure"]["episodes"] == 25 * report["draws"]
    assert report["mean_slots"]["oldest_first"] < report["mean_slots"]["generalist"] < report["mean_slots"]["bound"]
    assert report["beside_the_dqn"]["mean_slots"]["dqn_best"] > 10
    for figure in ("ratios.png", "reliability.png"):
        assert (tmp_path / figure).stat().st_size > 10_000


def test_generalist_planners(tmp_path):
    run("generalist_planners.py", "--layouts", 1, "--widths", 2, "--out", tmp_path)
    report = json.loads((tmp_path / "planners.json").read_text())
    assert report["episodes"] == 25
    assert set(report["mean_slots"]) == set(report["seconds"])
    assert report["mean_slots"]["generalist"] > 20


def test_generalist_elsewhere_and_speed(tmp_path):
    small = ("--layouts", 2, "--draws", 1, "--only", "6 devices", "48 devices", "round_lake")
    out = run("generalist_elsewhere.py", *small, "--out", tmp_path)
    assert "48 devices" in out
    assert "random weights" in out
    assert (tmp_path / "traffic.png").exists()
    run("generalist_speed.py", "--scenarios", 256, "--repetitions", 3, "--out", tmp_path)
    rows = json.loads((tmp_path / "speed.json").read_text())["policies"]
    assert all(row["decisions_per_second"] > 0 for row in rows.values())


def test_ship_generalist(tmp_path):
    out = run("ship_generalist.py", "--run", tmp_path / "run", "--into", tmp_path / "policy.npz", "--steps", 16_384)
    assert "policy.npz" in out
    assert load_policy(tmp_path / "policy.npz").n_devices is None

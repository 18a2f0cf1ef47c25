"""The scripts that measure runs on Ray work, at small sizes."""

import json

import pandas as pd
import pytest

from tests.experiments.scripts import run

pytestmark = [pytest.mark.ray, pytest.mark.full]


def test_faults(tmp_path):
    kinds = ["process of a shard killed", "driver killed"]
    run("faults.py", "--work", tmp_path / "work", "--out", tmp_path, "--faults", 1, "--kinds", *kinds)
    table = pd.read_csv(tmp_path / "faults.csv")
    assert sorted(table["fault"]) == sorted(kinds)
    assert table["same_bits"].all()
    assert json.loads((tmp_path / "faults.json").read_text())["kinds"]["driver killed"] == {"faults": 1, "same_bits": 1}


def test_ray_scale(tmp_path):
    sizes = ["--shards", 50, "--steps", 4000, "--nodes", 1]
    run("ray_scale.py", *sizes, "--work", tmp_path / "work", "--out", tmp_path)
    report = json.loads((tmp_path / "scale.json").read_text())
    assert report["stubs"]["shards"] == 50
    assert [row["nodes"] for row in report["study"]["nodes"]] == [0, 1]
    assert all(row["measured_s"] > 0 and row["simulated_s"] > 0 for row in report["study"]["nodes"])

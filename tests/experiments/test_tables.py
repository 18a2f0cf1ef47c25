"""The scripts of the paper's tables and figures run, at small sizes."""

import pytest

from tests.experiments.scripts import run


@pytest.mark.slow
def test_table5_grid(tmp_path):
    out = run("table5_grid.py", "--seeds", 1, "--steps", 400, "--out", tmp_path / "grid")
    assert "Lifetime in slots" in out
    assert (tmp_path / "grid" / "figure.png").exists()


@pytest.mark.full
def test_table6_rewards(tmp_path):
    out = run("table6_rewards.py", "--seeds", 1, "--steps", 400, "--out", tmp_path / "table6")
    assert "8 powered, 8 connected: lifetime in slots" in out
    assert (tmp_path / "table6" / "figure.png").exists()


@pytest.mark.full
def test_table7_evacuation(tmp_path):
    out = run("table7_evacuation.py", "--seeds", 1, "--steps", 400, "--out", tmp_path / "table7")
    assert "round_lake: first failures of each device" in out
    assert (tmp_path / "table7" / "figure.png").exists()
    pictures = {file.name for file in (tmp_path / "table7-pictures").iterdir()}
    assert pictures == {"round_lake.png", "round_lake.gif", "albany.png", "albany.gif"}


@pytest.mark.full
def test_figure3_training(tmp_path):
    run("figure3_training.py", "--steps", 20_000, "--out", tmp_path)
    assert (tmp_path / "figure3.png").stat().st_size > 20_000
    assert {folder.name for folder in tmp_path.iterdir() if folder.is_dir()} == {"learning-rates", "short", "seeds"}

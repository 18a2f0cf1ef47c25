"""`uavmec advise` and `uavmec evaluate` for fleets and horizons."""

import json

import pytest
from click.testing import CliRunner

from tests.hamlet import HAMLET
from uavmec_jax.cli import main

STATE = {
    "uavs": {"ada": {"at": "yard", "energy_j": 100_000.0}, "bob": {"at": "quay", "grounded": True, "energy_j": 5.0}},
    "packs": [1],
    "age_slots": {"tower": 9},
    "battery_j": {"mill": 4_000.0},
    "slot": 2,
    "elapsed_s": 1_200.0,
}


def run(folder, command, *arguments, state=None, file=HAMLET):
    (folder / "hamlet.toml").write_text(file)
    if state is not None:
        (folder / "now.json").write_text(json.dumps(state))
        arguments = (*arguments, "--state", folder / "now.json")
    scenario = [folder / "hamlet.toml"] if command == "advise" else [arguments[0], "--scenario", folder / "hamlet.toml"]
    rest = arguments if command == "advise" else arguments[1:]
    done = CliRunner().invoke(main, [command, *map(str, [*scenario, *rest])], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done


@pytest.mark.slow
def test_json_until_a_horizon(tmp_path):
    done = run(tmp_path, "advise", "--samples", 4, "--json", state=STATE)
    advice = json.loads(done.stdout)
    assert advice["policy"] == "earliest-deadline"
    assert advice["warnings"] == []
    ada, bob = advice["uavs"]
    assert [ada["name"], bob["name"]] == ["ada", "bob"]
    assert ada["next"]["name"] == ada["ranking"][0]["name"]
    assert {row["name"] for row in ada["ranking"]} == {"mill", "quay", "tower", "yard"}
    assert set(ada["ranking"][0]) == {"place", "name", "service", "behind", "behind_interval"}
    assert bob["next"] == {"place": None, "name": None, "action": "grounded"}
    assert bob["ranking"] == []
    assert bob["returns_in"] is None
    assert advice["seconds_left"] == 2400
    low, high = advice["service"]["interval"]
    assert 0 < low <= advice["service"]["mean"] <= high <= 1
    assert "lifetime" not in advice
    assert "failure_slot" not in advice
    assert set(advice["what_if"][0]) == {"device", "name", "change", "service", "gain"}
    assert advice["state"]["packs"] == {"yard": 1}


@pytest.mark.slow
def test_tables(tmp_path):
    shown = run(tmp_path, "advise", "--samples", 4).stdout
    flat = " ".join(shown.split())
    for words in ("Where each UAV goes next", "points", "First to fail", "share of the time left in service"):
        assert words in flat
    assert "ada: " in shown
    assert "The devices are then in service for" in flat
    assert "of the 60 min left to the horizon" in flat


@pytest.mark.slow
def test_a_trained_policy_decides_for_the_uavs_in_turn(tmp_path):
    settings = ("--set", "end=first_failure", "--samples", 2, "--no-what-if", "--json", "--policy", "generalist")
    done = run(tmp_path, "advise", *settings)
    advice = json.loads(done.stdout)
    line = (
        "hamlet: the policy was trained for one UAV without depots; here the UAVs decide one after another; a rule sends "
        "UAVs to depots"
    )
    assert f"uavmec: warning: {line}" in done.stderr.splitlines()
    assert line in advice["warnings"]
    assert advice["lifetime"]["futures"] == 2
    assert len(advice["uavs"]) == 2
    assert set(advice["uavs"][0]["ranking"][0]) == {"place", "name", "lifetime", "behind", "behind_interval"}


@pytest.mark.slow
def test_evaluate(tmp_path):
    rows = json.loads(run(tmp_path, "evaluate", "split-deadline", "--draws", 2, "--json").stdout)["policies"]
    assert [row["policy"] for row in rows] == ["split-deadline", "oldest-first", "earliest-deadline"]
    for row in rows:
        assert row["service_low"] <= row["service"] <= row["service_high"] < 1
        assert 0 <= row["censored"] <= 1
    shown = run(tmp_path, "evaluate", "generalist", "--draws", 2, "--set", "end=first_failure").stdout
    assert "Lifetime over 2 volume draws" in shown
    assert "here the UAVs decide one after another" in " ".join(shown.split())

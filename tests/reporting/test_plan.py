"""`uavmec plan`: its output, its files, and bad input."""

import json

import chex
import jax
import numpy as np
import pytest
from click.testing import CliRunner

from tests.scenarios.test_scenario_files import EXAMPLES
from uavmec_jax.cli import main
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.scenarios.load import load_scenario
from uavmec_jax.scenarios.scenario_files import load_scenario_file
from uavmec_jax.studies.population import evaluation_keys, make_agents
from uavmec_jax.studies.study import parse_study


def plan(*arguments):
    return CliRunner().invoke(main, ["plan", *map(str, arguments)], catch_exceptions=False)


@pytest.fixture(scope="module")
def harbour(tmp_path_factory):
    directory = tmp_path_factory.mktemp("plans") / "harbour"
    result = plan(EXAMPLES / "harbour.toml", "--draws", 3, "--width", 16, "--out", directory, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout), directory


@pytest.mark.slow
def test_json_is_complete(harbour):
    data, _ = harbour
    assert set(data["policies"]) == {*HEURISTICS, "rollout", "beam"}
    assert max(data["policies"].values()) <= data["bound"]
    assert set(data["tour"]) == {"rollout", "beam"}
    for name, tour in data["tour"].items():
        assert len(tour) == len(data["slots"][name])
        assert set(tour) <= set(range(1, 7))
    assert data["first_failing"]["device"] in range(1, 7)
    assert data["first_failing"]["cause"] in ("battery", "data_age")
    assert 0 < data["first_failing"]["share"] <= 1
    gains = [row["gain"] for row in data["what_if"]]
    assert gains == sorted(gains, reverse=True)
    changes = {(row["device"], row["change"]) for row in data["what_if"]}
    removals = {(device, "remove") for device in range(1, 7)}
    power = {(device, "repair power") for device in (1, 2, 3, 6)}
    comms = {(device, "repair comms") for device in (1, 3, 4)}
    assert changes == removals | power | comms


@pytest.mark.slow
def test_slots_add_up(harbour):
    data, _ = harbour
    slots = data["slots"]["rollout"]
    position = load_scenario_file(EXAMPLES / "harbour.toml").layout.position
    energy = 1.2e6
    here = np.zeros(2)
    for slot in slots:
        there = np.asarray(position[slot["device"] - 1])
        assert slot["flight_m"] == pytest.approx(np.linalg.norm(there - here), abs=1e-2)
        fly = slot["flight_m"] / 5
        energy -= 150 * fly + 80 * (slot["duration_s"] - fly)
        assert slot["uav_energy_j"] == pytest.approx(energy, rel=1e-4)
        assert slot["device"] in slot["served"]
        here = there


@pytest.mark.slow
def test_files(harbour):
    data, directory = harbour
    assert {file.name for file in directory.iterdir()} == {"tour.json", "tour.png", "tour.geojson", "scenario.toml"}
    assert json.loads((directory / "tour.json").read_text())["bound"] == data["bound"]
    assert load_scenario_file(directory / "scenario.toml").file == load_scenario_file(EXAMPLES / "harbour.toml").file
    features = json.loads((directory / "tour.geojson").read_text())["features"]
    assert [feature["geometry"]["type"] for feature in features] == ["Point"] * 6 + ["LineString"] * 2
    assert features[0]["geometry"]["coordinates"] == pytest.approx([9.9870, 53.5430], abs=1e-6)
    assert len(features[-1]["geometry"]["coordinates"]) >= 2


def test_a_seed_is_the_same_scenario_and_the_same_volumes_as_in_a_study():
    study = parse_study("[axes]\npowered = [8]\nconnected = [6]\nseeds = [3]", "x")
    scenario = load_scenario(powered=8, connected=6, seed=3)
    layout = make_agents(study).scenario.layout
    chex.assert_trees_all_equal(scenario.layout.position, layout.position[0])
    chex.assert_trees_all_equal(scenario.layout.has_comms, layout.has_comms[0])
    held_out = jax.random.key_data(evaluation_keys(study)[0, :5])
    chex.assert_trees_all_equal(jax.random.key_data(scenario.draws(5)), held_out)


@pytest.mark.slow
def test_tables_of_a_random_scenario(tmp_path):
    out = tmp_path / "tour"
    result = plan("--powered", 8, "--connected", 8, "--seed", 3, "--draws", 2, "--width", 8, "--out", out)
    assert result.exit_code == 0
    for text in ("Lifetime in slots", "The beam's tour (clairvoyant", "repair power", "First to fail: #6"):
        assert text in result.stdout
    assert {file.name for file in out.iterdir()} == {"tour.json", "tour.png", "scenario.toml"}


BAD = [
    (["--powered", "13"], "powered is 13; give 0 to 12, the number of devices"),
    (["--connected", "-1"], "--connected is -1; give a whole number from 0 to 1000"),
    (["--seed", "-1"], "--seed is -1; give a whole number from 0"),
    (["--draws", "0"], "--draws is 0; give a whole number from 1"),
    (["--width", "0"], "--width is 0; give a whole number from 1 to 100000"),
    (["--set", "uav_speed_m_s=0.0"], "--set: uav_speed_m_s is 0.0; it should be greater than or equal to"),
    (["--set", "device_battery_range_j=[8e4,5e4]"], "--set: device_battery_range_j is [80000.0, 50000.0]; give"),
    (["none.toml"], "none.toml: cannot be read: No such file"),
    ([str(EXAMPLES / "village.csv"), "--powered", "3"], "says which devices have power"),
    (
        [str(EXAMPLES / "village.csv"), "--set", "uav_battery_j=1000.0"],
        "the hop from the start to church, 361 m, takes 11",
    ),
]


@pytest.mark.parametrize(("arguments", "line"), BAD, ids=[line[:30] for _, line in BAD])
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, arguments, line):
    result = plan(*arguments, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert line in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()

"""`uavmec plan` as a user meets it: what it prints, writes and refuses."""

import json

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
    done = plan(EXAMPLES / "harbour.toml", "--draws", 3, "--width", 16, "--out", directory, "--json")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout), directory


@pytest.mark.slow
def test_json_says_everything(harbour):
    data, _ = harbour
    assert set(data["policies"]) == {*HEURISTICS, "rollout", "beam"}
    assert max(data["policies"].values()) <= data["bound"]
    for name, route in data["route"].items():
        assert len(route) == len(data["slots"][name])
        assert set(route) <= set(range(1, 7))
    assert data["first_failing"]["device"] in range(1, 7)
    assert data["first_failing"]["cause"] in ("battery", "data_age")
    assert 0 < data["first_failing"]["share"] <= 1
    gains = [one["gain"] for one in data["what_if"]]
    assert gains == sorted(gains, reverse=True)
    changes = {(one["device"], one["change"]) for one in data["what_if"]}
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
    assert {file.name for file in directory.iterdir()} == {"plan.json", "plan.png", "plan.geojson", "layout.toml"}
    assert json.loads((directory / "plan.json").read_text())["bound"] == data["bound"]
    assert load_scenario_file(directory / "layout.toml").file == load_scenario_file(EXAMPLES / "harbour.toml").file
    features = json.loads((directory / "plan.geojson").read_text())["features"]
    assert [feature["geometry"]["type"] for feature in features] == ["Point"] * 6 + ["LineString"] * 2
    assert features[0]["geometry"]["coordinates"] == pytest.approx([9.9870, 53.5430], abs=1e-6)
    assert len(features[-1]["geometry"]["coordinates"]) >= 2


def test_a_seed_is_the_same_town_and_the_same_volumes_as_in_a_study():
    study = parse_study("[axes]\npowered = [8]\nconnected = [6]\nseeds = [3]", "x")
    named_scenario, draws = load_scenario(None, powered=8, connected=6, seed=3, draws=5)
    agents = make_agents(study)
    np.testing.assert_array_equal(named_scenario.layout.position, agents.scenario.layout.position[0])
    np.testing.assert_array_equal(named_scenario.layout.has_comms, agents.scenario.layout.has_comms[0])
    theirs = jax.random.key_data(evaluation_keys(study)[0, :5])
    np.testing.assert_array_equal(jax.random.key_data(draws), theirs)


@pytest.mark.slow
def test_tables_of_a_random_town(tmp_path):
    done = plan("--powered", 8, "--connected", 8, "--seed", 3, "--draws", 2, "--width", 8, "--out", tmp_path / "town")
    assert done.exit_code == 0
    for words in ("Lifetime in slots", "The beam's tour (clairvoyant", "repair power", "First to fail: #6"):
        assert words in done.stdout
    assert not (tmp_path / "town" / "plan.geojson").exists()


BAD = [
    (["--powered", "13"], "--powered is 13; give 0 to 12, the number of devices"),
    (["--connected", "-1"], "--connected is -1; give 0 to 12"),
    (["--seed", "-1"], "--seed is -1; give a whole number from 0"),
    (["--draws", "0"], "--draws is 0; give a whole number from 1"),
    (["--width", "0"], "--width is 0; give 1 to 100000 states"),
    (["--set", "uav_speed_m_s=0.0"], "--set: uav_speed_m_s is 0.0; it should be greater than 0"),
    (["--set", "device_battery_range_j=[8e4,5e4]"], "--set: device_battery_range_j is [80000.0, 50000.0]; give"),
    (["none.toml"], "none.toml: cannot be read: No such file"),
    ([str(EXAMPLES / "village.csv"), "--powered", "3"], "says itself who has power"),
    (
        [str(EXAMPLES / "village.csv"), "--set", "uav_battery_j=1000.0"],
        "the hop from the start to church, 361 m, takes 11",
    ),
]


@pytest.mark.parametrize(("arguments", "line"), BAD, ids=[line[:30] for _, line in BAD])
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, arguments, line):
    done = plan(*arguments, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert line in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()

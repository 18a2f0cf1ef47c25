"""Studies of places: positions, traffic and rewards; bad settings are refused in one line."""

import chex
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.traffic.networks import evacuation
from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.errors import ArgumentError, StudyError, TrafficError
from uavmec_jax.reporting.tables import tables
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.runs.run import run_study
from uavmec_jax.runs.run_plan import plan_run
from uavmec_jax.scenarios.load import load_scenario
from uavmec_jax.scenarios.places import on_place
from uavmec_jax.scenarios.policies import load_policy
from uavmec_jax.scenarios.seeds import held_out_draws
from uavmec_jax.studies.population import cell_axes, make_agent_ids, make_agents
from uavmec_jax.studies.study import load_study, parse_study, study_toml
from uavmec_jax.traffic.evacuation import load_evacuation

TOML = """
steps = 400
[axes]
cells = [[8, 6]]
seeds = 2
place = ["round_lake", "albany"]
traffic_bonus = [0.0, 3.0]
[evaluation]
draws = 3
validate_every = 200
validation_draws = 2
planner_draws = 1
baselines = ["oldest-first"]
planners = ["rollout"]
"""


def test_devices_have_the_positions_and_the_traffic_of_the_place():
    study = parse_study(TOML, "x")
    assert cell_axes(study) == ["powered", "connected", "place", "traffic_bonus"]
    agent_ids, agents = make_agent_ids(study), make_agents(study)
    places = {name: load_evacuation(name) for name in ("round_lake", "albany")}
    for i, agent_id in enumerate(agent_ids):
        place = places[agent_id["place"]]
        assert_allclose(agents.scenario.layout.position[i], place.local_position(), atol=1e-3)
        assert_array_equal(agents.scenario.layout.traffic.weight[i], place.weight[None])
    assert_array_equal(agents.scenario.reward.traffic_bonus, [agent_id["traffic_bonus"] for agent_id in agent_ids])
    assert_array_equal(agents.scenario.reward.traffic_penalty, 0)
    chex.assert_tree_shape_prefix(agents, (8,))


def test_hardware_and_masks_are_those_of_the_seeds_random_layout():
    study = parse_study("[axes]\npowered = [8]\nconnected = [6]\nseeds = 2", "x")
    in_place, random = make_agents(parse_study(TOML, "x")).scenario.layout, make_agents(study).scenario.layout
    for name in ("capacity", "has_power", "has_comms", "device_type", "task"):
        assert_array_equal(getattr(in_place, name)[::4], getattr(random, name))
    assert random.traffic is None


def test_moving_weights_and_places_from_files(tmp_path):
    evacuation().save(tmp_path / "a.npz")
    evacuation(windows=((0, 0, 0), (0, 1, 0), (0, 0, 0.5))).save(tmp_path / "b.npz")
    changes = {
        "axes.place": [str(tmp_path / "a.npz"), str(tmp_path / "b.npz")],
        "params.n_devices": 3,
        "axes.cells": [[2, 1]],
    }
    traffic = make_agents(parse_study(TOML, "x", changes | {"traffic": "moving"})).scenario.layout.traffic
    assert traffic.weight.shape == (8, 3, 3)
    assert_allclose(
        traffic.weight[0], [[0, 0.2, 0.1], [1, 0.4, 0.1], [1, 0.4, 0.1]]
    )  # the last window lasts to the end
    assert_allclose(traffic.weight[2, 2], [0, 0, 0.5])
    assert_allclose(traffic.window_s, 600)
    scaled = make_agents(parse_study(TOML, "x", changes | {"place_scale_m": 800.0})).scenario.layout
    assert_allclose(scaled.position.max(), 800)


def test_study_round_trip():
    study = parse_study(TOML, "x", {"place_scale_m": 800.0, "traffic": "moving"})
    assert parse_study(study_toml(study), "x") == study
    assert parse_study(study_toml(parse_study(TOML, "x")), "x") == parse_study(TOML, "x")
    for name, agents in (("table7", 240), ("table7-ppo", 120)):
        assert len(make_agent_ids(load_study(name))) == agents


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"axes.place": ["albania"]}, "albania: neither a file nor a shipped place; did you mean 'albany'?"),
        ({"axes.place": ["none.npz"]}, "none.npz: cannot be read"),
        (
            {"params.n_devices": 10},
            "x: place 'round_lake' has 12 devices, params.n_devices is 10; set params.n_d",
        ),
        ({"axes.uav_speed_m_s": [5.0, 2.0]}, "round_lake: the hop from "),
        ({"params.slot_cap_s": 300.0}, "s at 5 m/s; a slot lasts at most 300 s (slot_cap_s)"),
        ({"axes.place": [3]}, "x: axes.place has 3; give names of places or paths of their files"),
        ({"axes.traffic_bonus": [-1.0]}, "x: axes.traffic_bonus has -1.0; give numbers from 0 to 1e+09"),
        ({"axes.traffic_bonus": [float("inf")]}, "x: axes.traffic_bonus has inf"),
        ({"traffic_penalty": -1.0}, "x: traffic_penalty is -1.0; it should be greater than or equal to 0"),
        ({"traffic": "fast"}, "x: traffic is 'fast'; it should be 'static' or 'moving'"),
        ({"place_scale_m": 0.0}, "x: place_scale_m is 0.0; it should be greater than or equal to 1"),
    ],
    ids=str,
)
def test_bad_setting_is_refused_in_one_line(changes, line):
    with pytest.raises((StudyError, TrafficError)) as error:
        plan_run(parse_study(TOML, "x", changes))
    assert line in str(error.value)
    assert "\n" not in str(error.value)


def test_traffic_without_a_place_is_refused():
    plain = "[axes]\npowered = [8]\nconnected = [6]\nseeds = 2\n"
    for name, value in (("traffic_bonus", 1.0), ("place_scale_m", 800.0), ("axes.traffic_penalty", [0.0, 1.0])):
        with pytest.raises(StudyError, match=f"{name.removeprefix('axes.')} is given, but no place"):
            parse_study(plain, "x", {name: value})


def test_a_layout_of_another_size_than_the_place_is_refused():
    layout = sample_layout(jax.random.key(0), Params(n_devices=5), 2, 2)
    with pytest.raises(ArgumentError, match=r"^layout has 5 devices; it should have those of albany, 12$"):
        on_place(layout, load_evacuation("albany"))


def test_random_scenario_in_a_place():
    scenario = load_scenario(place="albany", powered=8, connected=6, seed=3)
    place = load_evacuation("albany")
    assert scenario.name == "albany, 8 powered, 6 connected, seed 3"
    assert scenario.device_names == place.meta["names"]
    assert_allclose(scenario.layout.position, place.local_position(), atol=1e-3)
    assert_array_equal(scenario.layout.traffic.weight, place.weight[None])
    assert scenario.params.region_m == pytest.approx(place.region_m())
    assert int(np.sum(scenario.layout.has_power)) == 8
    chex.assert_trees_all_equal(scenario.draws(2), held_out_draws(3, 8, 6, 2))
    with pytest.raises(TrafficError, match="slot_cap_s"):
        load_scenario(place="albany", settings={"uav_speed_m_s": 1.0})


@pytest.mark.slow
def test_a_run_from_end_to_end(tmp_path):
    results = run_study(parse_study(TOML, "x"), tmp_path / "run")
    again = load_results(tmp_path / "run")
    assert again.run["places"]["albany"]["high_traffic"].count(True) == 4
    assert list(again.run["places"]) == ["round_lake", "albany"]
    titles = list(tables(again))
    assert [title.split(":")[0] for title in titles[1:3]] == ["round_lake", "albany"]
    assert titles[3].startswith("First failures on devices in high traffic")
    trained = load_policy(tmp_path / "run", place="albany", seed=1, traffic_bonus=3.0)
    assert trained.trained_on["place"] == "albany"
    fixed = run_study(
        parse_study(TOML, "x", {"place": "albany", "axes": {"cells": [[8, 6]], "seeds": 1}}), tmp_path / "fixed"
    )
    assert len(fixed.agents) == 1
    assert load_policy(tmp_path / "fixed", place="albany").trained_on["place"] == "albany"
    # The results of a heuristic do not depend on the rewards of the trained agents.
    oldest = results.agents.pivot_table(
        index=["seed", "place"], columns="traffic_bonus", values="oldest_first_lifetime"
    )
    assert_array_equal(oldest[0.0], oldest[3.0])

"""Studies with fleets: parts of one shape, the same draws for all fleets, planners left out, and whole runs."""

import re
from pathlib import Path

import chex
import jax
import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal

from uavmec_jax.env.dynamics import Cause
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.rollout import Episode
from uavmec_jax.errors import StudyError
from uavmec_jax.reporting.summary import summary
from uavmec_jax.reporting.tables import tables
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.runs.run import resume_run, run_study
from uavmec_jax.runs.run_plan import plan_run
from uavmec_jax.runs.simulate import simulate
from uavmec_jax.studies import planner_evaluation
from uavmec_jax.studies.evaluation_result import MISSING
from uavmec_jax.studies.parts import split_study
from uavmec_jax.studies.places import load_evacuations
from uavmec_jax.studies.population import (
    cell_axes,
    evaluation_keys,
    make_agent_ids,
    make_agents,
    n_agents,
    n_clairvoyant_seeds,
)
from uavmec_jax.studies.schema import Evaluation
from uavmec_jax.studies.study import load_study, parse_study, study_toml

TOML = """
algorithm = "none"
[axes]
powered = [3, 1]
connected = [2]
uavs = [1, 2]
depots = [0, 1]
uav_battery_j = [8e5, 1.6e6]
seeds = 2
[[depot]]
x_m = 0.0
y_m = 10.0
kind = "charge"
pads = 1.0
[params]
n_devices = 4
max_slots = 12
[evaluation]
draws = 2
planner_draws = 1
baselines = ["oldest-first", "earliest-deadline"]
planners = ["rollout"]
rollout_samples = 1
"""


@pytest.fixture(scope="module")
def study():
    return parse_study(TOML, "fleets")


def test_it_is_split_into_parts_of_one_shape(study):
    parts = split_study(study)
    assert [part.name for part in parts] == [f"none, uavs={k}, depots={d}" for k in (1, 2) for d in (0, 1)]
    assert n_agents(study) == len(make_agent_ids(study)) == 2 * 2 * 2 * 4
    assert cell_axes(study) == ["powered", "connected", "uavs", "depots", "uav_battery_j"]
    ids = make_agent_ids(study)
    assert list(ids[0]) == ["seed", *cell_axes(study)]
    assert [(agent_id["uavs"], agent_id["depots"]) for agent_id in ids[::8]] == [(1, 0), (1, 1), (2, 0), (2, 1)]
    plan = plan_run(study, shard_size=5)
    assert list(plan.partitions) == [part.name for part in parts]
    assert [(shard.part, shard.first, shard.agents) for shard in plan.shards[:3]] == [
        (parts[0].name, 0, 5), (parts[0].name, 5, 3), (parts[1].name, 0, 5)
    ]  # fmt: skip
    assert plan.work == sum(map(plan.work_of, plan.shards)) == 32
    assert simulate(study, plan, speed=1.0, devices=1).training_s == 0


def test_fleets_have_the_same_layouts_and_draws(study):
    parts = [part.study for part in split_study(study)]
    layouts = [make_agents(part).scenario.layout for part in parts]
    without = lambda layout: layout.replace(fleet=None, depots=None)  # noqa: E731
    for part, layout in zip(parts, layouts, strict=True):
        chex.assert_trees_all_equal(without(layout), layouts[0])
        keys = evaluation_keys(part), make_agents(part).key
        chex.assert_trees_all_equal(
            *(
                jax.tree.map(jax.random.key_data, k)
                for k in (keys, (evaluation_keys(parts[0]), make_agents(parts[0]).key))
            )
        )
    assert layouts[0].fleet is None
    assert layouts[0].depots is None
    last = layouts[-1]
    assert (last.n_uavs, last.n_depots, layouts[1].n_uavs, layouts[2].n_depots) == (2, 1, 1, 0)
    assert_array_equal(last.fleet.battery_j, np.repeat(np.float32([8e5, 1.6e6] * 4), 2).reshape(8, 2))
    assert_array_equal(last.fleet.start_m, np.tile(np.float32([0.0, 10.0]), (8, 2, 1)))
    assert_array_equal(last.depots.pads, np.ones((8, 1)))
    assert_array_equal(last.depots.kind, np.ones((8, 1)))


def test_a_study_of_one_uav_without_depots_has_no_trace_of_fleets():
    plain = load_study("planning")
    assert isinstance(layout := make_agents(plain, agent_ids=make_agent_ids(plain)[:2]).scenario.layout, Layout)
    assert layout.fleet is None
    assert list(plan_run(plain).partitions) == ["none"]
    assert not {"uavs", "depot", "depots", "clairvoyant_seeds", "horizon_s", "end"} & set(study_toml(plain).split())


def test_the_shipped_study():
    study = load_study("fleet")
    assert [part.name for part in split_study(study)] == [f"none, uavs={k}" for k in (1, 2, 3)]
    assert [n_clairvoyant_seeds(part.study) for part in split_study(study)] == [100, 100, 20]
    agents = make_agents(split_study(study)[2].study, agent_ids=make_agent_ids(split_study(study)[2].study)[:2])
    assert (agents.scenario.layout.n_uavs, agents.scenario.layout.n_depots) == (3, 1)


def test_round_trip(study):
    assert parse_study(study_toml(study), "again") == study.model_copy(update={"name": "fleets"})


def test_the_docs_show_studies():
    text = (Path(__file__).parents[2] / "docs" / "studies.md").read_text(encoding="utf-8")
    studies = [parse_study(block, "docs") for block in re.findall(r"```toml\n(.*?)```", text, re.DOTALL)]
    assert [study.name for study in studies] == ["my-study", "my-fleets"]
    assert n_agents(studies[1]) == 2 * 2 * 3 * 3 * 2 * 20


BAD = [
    ({"uavs": 0}, "bad.toml: uavs is 0; it should be greater than or equal to 1"),
    ({"uavs": 101}, "bad.toml: uavs is 101; it should be less than or equal to 100"),
    ({"axes.uavs": [1, 0]}, "bad.toml: axes.uavs has 0; give whole numbers from 1 to 100"),
    ({"axes.uavs": [1.5]}, "bad.toml: axes.uavs has 1.5; give whole numbers from 1 to 100"),
    ({"axes.depots": [2]}, "bad.toml: axes.depots has 2; give whole numbers from 0 to 1, the number of depot tables"),
    ({"depot": [], "axes.depots": [1]}, "bad.toml: axes.depots has 1; add a table [[depot]] for each"),
    ({"depots": 2}, "bad.toml: depots is 2; give whole numbers from 0 to 1, the number of depot tables"),
    ({"depot": [{"x_m": 1.0}]}, "bad.toml: depot 1 (no name): y_m is missing"),
    (
        {"depot": [{"x_m": 1.0, "y_m": 1.0, "pads": 0.0}]},
        "bad.toml: depot 1 (no name): pads is 0.0; it should be greater than or",
    ),
    (
        {"depot": [{"x_m": 1.0, "y_m": 1.0, "kind": "fuel"}]},
        "bad.toml: depot 1 (no name): kind is 'fuel'; it should be 'swap' or",
    ),
    (
        {"depot": [{"x_m": 1.0, "y_m": 1.0, "pad": 1.0}]},
        "bad.toml: depot 1 (no name): pad is not a setting; did you mean 'pads'?",
    ),
    (
        {"depot": [{"x_m": 1.0, "y_m": 1.0}, {"x_m": 900.0, "y_m": 0.0}]},
        "bad.toml: depot 2 (no name): is at [900.0, 0.0], outside params.region_m, 800 x 800 m; give x_m and y_m inside",
    ),
    (
        {"algorithm": "dqn"},
        "bad.toml: axes.uavs has 2, and algorithm is 'dqn', which trains for one UAV without depots; set algorithm = 'none'",
    ),
    (
        {"algorithm": "ppo", "axes.uavs": [1], "axes.depots": [0, 1]},
        "bad.toml: axes.depots has 1, and algorithm is 'ppo', which trains for one UAV",
    ),
    (
        {"evaluation.clairvoyant_seeds": []},
        "bad.toml: evaluation.clairvoyant_seeds is empty; give a number for one UAV",
    ),
    (
        {"evaluation.clairvoyant_seeds": [-1]},
        "bad.toml: evaluation.clairvoyant_seeds: item 1 is -1; it should be greater",
    ),
    ({"reward": {"X": 1.0}}, "bad.toml: reward has the term 'X', which is not one; known: A, U, M, O, log A"),
    (
        {"params.end": "horizon", "evaluation.planners": ["rollout", "bound"]},
        "bad.toml: evaluation.planners has 'bound', which is about the first failure, and params.end is 'horizon'; give",
    ),
    ({"axes.end": ["horizon"]}, "bad.toml: axes.end is not an axis"),
]


@pytest.mark.parametrize(("change", "message"), BAD, ids=[message[10:50] for _, message in BAD])
def test_bad_setting_is_refused_in_one_line(change, message):
    with pytest.raises(StudyError) as error:
        parse_study(TOML, "bad.toml", change)
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def test_drawn_scenarios_have_one_uav():
    drawn = 'algorithm = "none"\nuavs = 2\n[axes]\nseeds = 1\n[scenarios]\n[params]\nn_devices = 16\n'
    with pytest.raises(
        StudyError, match=r"^x: uavs is 2, and scenarios are given, which have one UAV; leave one of them"
    ):
        parse_study(drawn, "x")
    with pytest.raises(StudyError, match=r"^x: evaluation.clairvoyant_seeds is given, but with \[scenarios\]"):
        parse_study(drawn, "x", {"uavs": 1, "evaluation.clairvoyant_seeds": [1]})


def test_a_horizon_and_the_term_of_service_are_settings():
    changes = {"params.end": "horizon", "axes.horizon_s": [6e3, 12e3], "axes.uavs": [1], "axes.depots": [0]}
    study = parse_study(TOML, "x", changes | {"reward": {"U": 1.0, "S": 2.0}})
    scenario = make_agents(split_study(study)[0].study).scenario
    assert scenario.params.end == "horizon"
    assert_array_equal(scenario.params.horizon_s[:2], [6e3, 12e3])
    assert_array_equal(scenario.reward.service, np.full(16, 2.0))
    assert parse_study(study_toml(study), "again").params == study.params


def test_a_depot_outside_a_place_is_refused():
    changes = {"place": "albany", "params.n_devices": 12, "depot": [{"x_m": 1e5, "y_m": 0.0}]}
    with pytest.raises(StudyError, match=r"x: depot 1 \(no name\): is at \[100000.0, 0.0\], outside place 'albany', "):
        load_evacuations(parse_study(TOML, "x", changes))


# Which agents are evaluated by beam and bound


def episodes_of(lifetimes):
    """Make episodes with given lifetimes in which device 2 of 4 fails first."""
    first = np.zeros((len(lifetimes), 4), np.float32)
    first[:, 1] = 1
    cause = np.full(len(lifetimes), Cause.BATTERY, np.int32)
    return Episode(length=np.asarray(lifetimes, np.int32), cause=cause, failed=first > 0, first_failure=first)


def test_beam_and_bound_are_evaluated_for_some_agents_only(study, monkeypatch):
    part = split_study(parse_study(TOML, "x", {"evaluation.clairvoyant_seeds": [1, 0]}))[0].study
    assert (n_clairvoyant_seeds(part), n_clairvoyant_seeds(part.model_copy(update={"uavs": 7}))) == (1, 0)
    asked = []

    def beam(params, layouts, keys, **_):
        return None, episodes_of(5 + np.arange(len(keys)))

    def bound(params, layouts, keys, at_least, **_):
        asked.append(at_least)
        return np.asarray(at_least, np.int32) + 1

    monkeypatch.setattr(planner_evaluation, "beam_episodes", beam)
    monkeypatch.setattr(planner_evaluation, "bound_scenarios", bound)
    monkeypatch.setattr(planner_evaluation, "planned_slots", lambda *_: 64)
    settings = Evaluation(planners=("beam", "bound"), planner_draws=2)
    agents, keys = make_agents(part), evaluation_keys(part)[:, :-1]
    chosen = np.array([agent_id["seed"] == 0 for agent_id in make_agent_ids(part)])
    lifetimes = [np.full((8, 3), 7, np.int32)]
    everything = planner_evaluation.evaluate_planners(agents, keys, settings, lifetimes)
    some = planner_evaluation.evaluate_planners(agents, keys, settings, lifetimes, chosen)
    none = planner_evaluation.evaluate_planners(agents, keys, settings, lifetimes, np.zeros(8, bool))
    assert list(some) == list(none) == list(everything) == ["beam", "bound"]
    assert [len(at_least) for at_least in asked] == [16, 8]
    assert_array_equal(some["beam"].lifetime, [[5, 6], [7, 8], [9, 10], [11, 12], *[[MISSING] * 2] * 4])
    assert_array_equal(some["bound"].lifetime[:5], [[8, 8], [8, 9], [10, 11], [12, 13], [MISSING] * 2])
    assert_array_equal(some["beam"].mean_lifetime, [5.5, 7.5, 9.5, 11.5, *[np.nan] * 4])
    assert_array_equal(none["bound"].mean_lifetime, [np.nan] * 8)
    for name, result in vars(everything["beam"]).items():
        if result is not None:
            others = vars(some["beam"])[name], vars(none["beam"])[name]
            assert {(array.shape, array.dtype) for array in others} == {(result.shape, result.dtype)}
    columns = some["beam"].columns("beam")
    assert columns["beam_cause"] == ["battery"] * 4 + [""] * 4
    assert_array_equal(columns["beam_first_device"], [2] * 4 + [np.nan] * 4)


# Whole runs

GRID = TOML.replace("uav_battery_j = [8e5, 1.6e6]\n", "")


@pytest.mark.slow
def test_a_run_of_heuristics(tmp_path):
    """Two cells of each fleet, cut into several shards, and stopped after the first."""
    study = parse_study(GRID, "fleets", {"evaluation.planners": [], "evaluation.baselines": ["oldest-first"]})

    def stop(progress):
        raise KeyboardInterrupt

    assert not run_study(study, tmp_path / "run", shard_size=2, on_progress=stop).run["complete"]
    results = resume_run(tmp_path / "run")
    agents = results.agents
    assert results.run["complete"]
    assert agents.columns[:5].tolist() == ["seed", "powered", "connected", "uavs", "depots"]
    assert agents[["seed", "powered", "uavs", "depots"]].to_numpy().tolist() == [
        [agent_id[axis] for axis in ("seed", "powered", "uavs", "depots")] for agent_id in make_agent_ids(study)
    ]
    assert agents["oldest_first_lifetime"].between(1, 12).all()
    always = agents["oldest_first_censored"] == 1
    assert always.any()
    assert (agents["oldest_first_cause"][always] == "none").all()
    assert results.run["partitions"].keys() == {part.name for part in split_study(study)}
    pd.testing.assert_frame_equal(load_results(tmp_path / "run").agents, agents, check_dtype=False)
    assert tables(results)
    assert summary(results)


@pytest.mark.slow
def test_a_run_with_a_planner_until_a_horizon(tmp_path):
    changes = {"params.end": "horizon", "params.horizon_s": 4000.0, "axes.uavs": [2], "axes.depots": [1]}
    study = parse_study(GRID, "fleets", changes)
    results = run_study(study, tmp_path / "run")
    agents = results.agents
    for policy in ("oldest_first", "earliest_deadline", "rollout"):
        assert agents[f"{policy}_service"].between(0, 1.2).all()
        assert set(agents[f"{policy}_cause"]) <= {"horizon", "none", "share"}
    assert agents["rollout_service"].mean() >= agents["oldest_first_service"].mean() - 0.05
    assert any("in service" in title for title in tables(results))
    assert summary(load_results(tmp_path / "run"))


@pytest.mark.slow
def test_a_run_with_planners(tmp_path):
    changes = {"axes.powered": [2, 0], "axes.connected": [1], "axes.depots": [1], "params.max_slots": 64}
    changes["params.device_battery_range_j"] = [20_000.0, 40_000.0]  # few of the episodes are censored
    planners = {"evaluation.planners": ["rollout", "beam"], "evaluation.clairvoyant_seeds": [2, 1]}
    study = parse_study(GRID, "fleets", changes | planners | {"evaluation.beam_width": 4})
    results = run_study(study, tmp_path / "run")
    agents = results.agents
    assert agents["rollout_planned"].notna().all()
    assert (agents["beam_planned"].isna() == ((agents["uavs"] == 2) & (agents["seed"] == 1))).all()
    both = agents.dropna(subset=["beam_planned"])
    assert both["beam_planned"].mean() >= both["oldest_first_planned"].mean()
    pd.testing.assert_frame_equal(load_results(tmp_path / "run").agents, agents, check_dtype=False)
    assert "of 4 layouts" in " ".join(summary(results))

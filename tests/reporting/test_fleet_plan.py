"""Plans of fleets: tables, plain data, GeoJSON and figures of a plan made by hand; `uavmec plan` on small fleets."""

import io
import json

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose
from rich.console import Console

from tests.hamlet import HAMLET, hamlet, hamlet_plan
from uavmec_jax.cli import main
from uavmec_jax.env.scenario import make_scenario
from uavmec_jax.planning.heuristics import FLEET_HEURISTICS
from uavmec_jax.reporting.geojson import tour_geojson
from uavmec_jax.reporting.map_figure import map_pixels
from uavmec_jax.reporting.plan import plan_data, plan_summary, plan_tables, save_plan
from uavmec_jax.reporting.tour_figure import tour_figure
from uavmec_jax.scenarios.scenario_files import load_scenario_file

ENDS = ("horizon", "first_failure")


def text(tables, lines=()):
    console = Console(width=100, record=True, file=io.StringIO())
    for title, table in tables.items():
        console.print(title)
        console.print(table)
    for line in lines:
        console.print(line, soft_wrap=True)
    return console.export_text()


def printed(end):
    return text(plan_tables(hamlet_plan(end), hamlet(end)), plan_summary(hamlet_plan(end), hamlet(end)))


def rows(shown, title):
    """The cells of a printed table's rows, after its title."""
    lines = shown[shown.index(title) :].splitlines()
    end = next(number for number, line in enumerate(lines) if line.startswith("└"))
    return [[cell.strip() for cell in line.strip("│").split("│")] for line in lines[:end] if line.startswith("│")]


@pytest.mark.slow
def test_data_of_every_uav():
    data = plan_data(hamlet_plan(), hamlet())
    slots = data["slots"]["rollout"]
    assert data["uavs"] == ["ada", "bob"]
    assert data["places"] == ["mill", "quay", "tower", "yard"]
    assert data["tour"]["rollout"][:3] == [[2, 1], [2, 1], [4, 1]]
    ada, bob = zip(*(row["uavs"] for row in slots), strict=True)
    assert [uav["target"] for uav in ada[:6]] == ["quay", "quay", "yard", "yard", "tower", "tower"]
    assert [uav["flies"] for uav in ada[:6]] == [True, False, True, False, True, False]
    assert [uav["at_depot"] for uav in ada[:6]] == [None, None, "yard", "yard", None, None]
    assert [uav["depot_service"] for uav in ada[:4]] == [None, None, "swap", None]
    assert ada[2]["energy_j"] == 1.6e6
    assert [uav["grounded"] for uav in bob[:3]] == [False, True, True]
    assert bob[0]["energy_j"] == 12_000  # of 60 kJ, after 600 s at 80 W
    assert slots[1]["served"] == [2]
    assert [row["dead"] for row in slots[:4]] == [[], [], [1], [1]]
    assert slots[2]["lowest_battery"]["device"] == 2  # of those that work
    assert_allclose([row["elapsed_s"] for row in slots[:4]], [600, 1200, 1800, 2400])


def test_data_until_a_horizon():
    data = plan_data(hamlet_plan(), hamlet())
    assert "policies" not in data
    assert "bound" not in data
    # The mill weighs as much as the others together and is in service for 1,200 s, the others all the time.
    mill, quay, tower = data["device_service"]
    assert_allclose(mill["in_service"], 1200 / 3600)
    assert_allclose(
        data["service"]["rollout"], np.average([row["in_service"] for row in data["device_service"]], weights=[2, 1, 1])
    )
    assert [mill["battery_empty_slot"], mill["battery_empty_s"]] == [3, 1800]
    assert quay["battery_empty_s"] is None
    assert tower["name"] == "tower"
    assert data["service"]["rollout"] <= data["service_bound"] < 1
    assert data["first_failing"] == {"device": 1, "name": "mill", "share": 1.0, "cause": "battery"}
    measures = data["measures"]
    assert [measures["first_failure_slot"], measures["failure_share"]] == [3, 1]
    assert [measures["flights"], measures["packs_used"]] == [4, 2]
    assert data["what_if"][0] == {"device": 1, "name": "mill", "change": "repair power", "service": 0.75, "gain": 0.125}
    json.dumps(data, allow_nan=False)


def test_data_until_the_first_failure():
    data = plan_data(hamlet_plan("first_failure"), hamlet("first_failure"))
    assert data["policies"] == {"oldest-first": 2, "rollout": 3, "beam": 4}
    assert data["bound"] == 5
    assert data["censored"] == dict.fromkeys(("oldest-first", "rollout", "beam", "bound"), 0)
    assert set(data["slots"]) == {"rollout", "beam"}
    assert data["what_if"][1] == {"device": 2, "name": "quay", "change": "remove", "lifetime": 4, "gain": -1}
    assert data["measures"]["packs_used"] == 1


def test_table_of_a_tour():
    shown = rows(printed("horizon"), "The rollout planner's tour")
    assert [row[:4] for row in shown] == [
        ["1", "0:10", "#2 1549", "#1 12"],
        ["2", "0:20", "#2 1501", "grounded"],
        ["3", "0:30", "D1 swap", "grounded"],
        ["4", "0:40", "D1 1600", "grounded"],
        ["5-6", "0:41", "#3 1591", "grounded"],
        ["7", "0:51", "D1 swap", "grounded"],
        ["8", "1:01", "D1 1600", "grounded"],
    ]
    assert [row[-1] for row in shown] == ["", "", *["#1"] * 5]


def test_tables_until_a_horizon():
    shown = printed("horizon")
    assert rows(shown, "Share of the 60 min in which devices are in service")[-1][:2] == ["upper bound", "75.7%"]
    assert rows(shown, "Devices under the rollout planner")[0] == ["#1 mill", "33.3%", "0:30", "100%"]
    assert ["batteries swapped", "2.0"] in rows(shown, "Measures of the rollout planner's tours")
    assert rows(shown, "What a repair or a removal would bring")[0] == [
        "1",
        "#1 mill",
        "repair power",
        "75.0%",
        "+12.5",
    ]
    assert "First to fail: #1 mill, in 100% of the draws; its battery runs out." in shown
    assert "in service for 66.7% of the 60 min. No policy reaches more than 75.7%" in shown
    assert "Depots: D1 yard." in shown


def test_tables_until_the_first_failure():
    shown = printed("first_failure")
    assert rows(shown, "Lifetime in slots")[-1] == ["upper bound", "5.00", "5", "5"]
    assert rows(shown, "What a repair or a removal would bring")[1][-2:] == ["4.00", "-1.00"]
    assert "Rollout planner 3.00 slots; the beam, which knows the volumes, 4.00; the upper bound is 5.00" in shown


def test_lifetimes_that_reach_the_limit_are_at_least_that():
    plan = hamlet_plan("first_failure")
    limited = plan.__class__(**{**vars(plan), "params": plan.params.replace(max_slots=3)})
    shown = text(plan_tables(limited, hamlet("first_failure")), plan_summary(limited, hamlet("first_failure")))
    assert rows(shown, "Lifetime in slots")[1] == ["rollout planner", "≥ 3.00", "≥ 3", "≥ 3"]
    assert rows(shown, "Lifetime in slots")[0] == ["oldest-first", "2.00", "2", "2"]
    assert (
        "in 2 of 2 draws the network is alive after 3 slots, where planning ends, and lives at least that long" in shown
    )
    assert "give max_slots" in shown
    assert plan_data(limited, hamlet("first_failure"))["censored"]["rollout"] == 1


def test_geojson_has_a_line_for_each_uav_depots_and_the_region():
    scenario = hamlet()
    features = tour_geojson(scenario, hamlet_plan())["features"]
    assert [feature["geometry"]["type"] for feature in features] == ["Point"] * 4 + ["LineString"] * 2 + ["Polygon"]
    depot, ada, bob, region = features[3:]
    assert depot["properties"] == {"depot": 1, "name": "yard", "kind": "swap", "pads": 1, "packs": 2, "power_w": None}
    assert depot["geometry"]["coordinates"] == pytest.approx([9.001, 53.001], abs=1e-7)
    assert [line["properties"]["uav"] for line in (ada, bob)] == ["ada", "bob"]
    assert ada["properties"]["places"] == ["quay", "quay", "yard", "yard", "tower", "tower", "yard", "yard"]
    path = [
        [9.001, 53.001],
        [9.002, 53.003],
        [9.001, 53.001],
        [9.004, 53.0005],
        [9.001, 53.001],
    ]  # she starts at the depot
    assert_allclose(ada["geometry"]["coordinates"], path, atol=1e-6)
    assert len(bob["geometry"]["coordinates"]) == 2  # where he was all the time
    assert bob["properties"]["grounded_in_slot"] == 2
    assert features[0]["properties"]["priority"] == 2
    corners = scenario.file.region
    assert_allclose(region["geometry"]["coordinates"][0], [*corners, corners[0]], atol=1e-7)


@pytest.mark.parametrize("end", ENDS)
def test_figure(end):
    figure = tour_figure(hamlet_plan(end), hamlet(end))
    assert len(figure.axes) == (4 if end == "horizon" else 8)
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert {"ada", "bob", "bob grounded", "swap depot"} <= set(labels)
    energies = figure.axes[3].lines
    assert [line.get_label() for line in energies] == ["ada", "bob"]
    assert_allclose(energies[0].get_ydata()[[0, 3]], [1600, 1600])
    figure.canvas.draw()


def test_files(tmp_path):
    save_plan(hamlet_plan(), hamlet(), tmp_path, "uavmec plan hamlet.toml")
    assert {file.name for file in tmp_path.iterdir()} == {"tour.json", "tour.png", "tour.geojson", "scenario.toml"}
    assert json.loads((tmp_path / "tour.json").read_text())["uavs"] == ["ada", "bob"]
    assert load_scenario_file(tmp_path / "scenario.toml").file == hamlet().file


def test_pixels_show_all_uavs():
    scenario, state = make_scenario(hamlet().layout, hamlet().params), hamlet().state
    moved = state.replace(uav_position=state.uav_position.at[1].set(scenario.layout.places()[2]))
    images = [map_pixels(scenario, one, visited) for one, visited in ((state, None), (moved, None), (moved, [3, 2]))]
    assert all(image.shape == (480, 640, 3) for image in images)
    assert (images[0] != images[1]).any()
    assert (images[1] != images[2]).any()


def run_plan(tmp_path, *arguments):
    file = tmp_path / "hamlet.toml"
    file.write_text(HAMLET)
    width = ("--width", 2) if "end=first_failure" in arguments else ()
    arguments = [file, "--draws", 1, *width, "--out", tmp_path / "out", *arguments]
    done = CliRunner().invoke(main, ["plan", *map(str, arguments)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.mark.slow
def test_plan_until_a_horizon(tmp_path):
    data = json.loads(run_plan(tmp_path, "--json"))
    assert set(data["service"]) == {*FLEET_HEURISTICS, "rollout"}
    assert max(data["service"].values()) <= data["service_bound"]
    assert list(data["tour"]) == ["rollout"]
    assert data["max_slots"] == 1000
    gains = [row["gain"] for row in data["what_if"]]
    assert gains == sorted(gains, reverse=True)
    assert {(row["device"], row["change"]) for row in data["what_if"]} >= {(1, "repair power"), (3, "remove")}
    assert data["what_if"][0]["name"] == "mill"
    assert (tmp_path / "out" / "tour.geojson").exists()


@pytest.mark.slow
def test_plan_until_the_first_failure(tmp_path):
    data = json.loads(run_plan(tmp_path, "--set", "end=first_failure", "--json"))
    assert set(data["policies"]) == {*FLEET_HEURISTICS, "rollout", "beam"}
    assert data["max_slots"] == 64  # a depot may let UAVs fly on for ever
    assert max(data["policies"].values()) <= data["bound"] <= 64


@pytest.mark.slow
def test_a_plan_that_does_not_end(tmp_path, monkeypatch):
    """With grid power everywhere, the tower's data are fetched for ever; the output says how far was planned."""
    powered = HAMLET.replace("capacity_j = 9_000.0", "capacity_j = 9_000.0\npower = true")
    monkeypatch.setattr("tests.reporting.test_fleet_plan.HAMLET", powered.replace("comms = true", "power = true"))
    shown = run_plan(tmp_path, "--set", "end=first_failure", "--set", "max_slots=9")
    assert "≥ 9.00" in shown
    assert "alive after 9 slots" in " ".join(shown.split())


def test_only_a_depot_without_another_end_limits_the_slots():
    assert hamlet().with_slot_limit(64).params.max_slots == 1000
    assert hamlet("first_failure").with_slot_limit(64).params.max_slots == 64

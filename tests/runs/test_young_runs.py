"""Runs of which little is there: no shard is finished, or a file is lost, emptied or another run's."""

import json
import shutil

import pytest
from click.testing import CliRunner

import uavmec_jax as um
from tests.runs.processes import UNTRAINED, bits, plan_in, stop_after
from uavmec_jax.cli import main
from uavmec_jax.errors import StudyError
from uavmec_jax.runs.folder import _digest
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.runs.run import resume_run, run_study
from uavmec_jax.runs.status import run_status
from uavmec_jax.studies.study import parse_study

STUDY = parse_study(UNTRAINED, "untrained")
OTHER = parse_study(UNTRAINED, "untrained", {"axes.seeds": 3})
PLACE = parse_study(UNTRAINED, "untrained", {"place": "albany"})
TRAINED = parse_study(UNTRAINED, "untrained", {"algorithm": "a2c", "steps": 1000, "axes.learning_rate": [0.001, 0.01]})


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Runs that are planned, half done and whole, and one of another study."""
    top = tmp_path_factory.mktemp("runs")
    plan_in(top / "planned", STUDY, shard_size=2)
    run_study(STUDY, top / "half", shard_size=2, command="x", on_progress=stop_after(2))
    run_study(STUDY, top / "whole", shard_size=2, command="x")
    run_study(OTHER, top / "other", command="x")
    return top


@pytest.fixture
def copied(folders, tmp_path):
    return lambda name: shutil.copytree(folders / name, tmp_path / name)


def shown(*arguments):
    done = CliRunner().invoke(main, ["show", *map(str, arguments)], terminal_width=200)
    assert done.exit_code == 0, done.output
    return " ".join(done.stdout.split())


def refused(*arguments):
    done = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert done.exit_code == 2, done.output
    assert done.stderr.count("\n") == 1
    return done.stderr


@pytest.mark.parametrize("study", [STUDY, PLACE, TRAINED], ids=["grid", "place", "trained"])
def test_a_run_without_a_finished_shard_is_shown_as_far_as_it_is(tmp_path, study):
    directory = plan_in(tmp_path / "run", study, shard_size=2)
    text = shown(directory)
    assert f"0 of {len(study.axes.get('learning_rate', '1')) * 4} agents are finished." in text
    assert "untrained, a run that is not complete" in text
    assert "waiting" in text
    data = json.loads(CliRunner().invoke(main, ["show", str(directory), "--json"]).stdout)
    assert (data["cells"], data["run"]["complete"], data["status"]["complete"]) == ([], False, False)
    results = load_results(directory)
    assert len(results.cells()) == len(results.curve_table()) == len(results.episode_table()) == 0


def test_a_run_that_is_half_done_is_shown_as_far_as_it_is(folders):
    text = shown(folders / "half")
    assert "Lifetime in slots" in text
    assert "2 of 4 agents are finished." in text
    assert "1 done" in text


def test_a_run_without_a_finished_shard_cannot_be_compared(folders):
    line = refused("compare", folders / "planned", folders / "whole", "--policy-a", "oldest-first")
    assert line == "uavmec: untrained: none of its agents is finished; resume the run, or wait for it\n"


def test_a_run_whose_run_json_is_lost_is_shown_without_what_it_cost(folders, copied):
    directory = copied("whole")
    (directory / "run.json").unlink()
    text = shown(directory)
    assert "Lifetime in slots" in text
    assert "Not known, since run.json is lost: what the run cost, and whether its files are as it wrote them." in text
    results, whole = load_results(directory), load_results(folders / "whole")
    assert results.agents.equals(whole.agents)
    assert (results.run["complete"], results.run["seeds"]) == (True, [0, 1])
    assert run_status(directory).complete is False
    resume_run(directory)
    assert bits(directory) == bits(folders / "whole")


def test_a_run_that_has_lost_all_but_its_study_is_one_line(copied):
    directory = copied("whole")
    for file in directory.iterdir():
        if file.name != "study.toml" and file.is_file():
            file.unlink()
    assert "holds no run (run.json is missing)" in refused("show", directory)
    assert "holds no run that can be resumed (run_plan.json is missing)" in refused("resume", directory)


CONTENTS = {
    "empty": "",
    "list": "[]",
    "null": "null",
    "text": '"text"',
    "nested": "[" * 200_000,
    "twice": '{"schema": 2, "schema": 2}',
    "infinite": '{"schema": Infinity}',
    "digits": '{"schema": ' + "1" * 5000 + "}",
    "true": '{"schema": true}',
    "schema alone": '{"schema": 3}',
    "plan alone": '{"schema": 2}',
}


@pytest.mark.parametrize("content", CONTENTS.values(), ids=CONTENTS.keys())
@pytest.mark.parametrize("name", ["run.json", "run_plan.json"])
def test_a_run_json_or_plan_that_is_something_else_is_one_line(copied, name, content):
    directory = copied("whole" if name == "run.json" else "half")
    (directory / name).write_text(content)
    assert f"{name}: " in refused("show" if name == "run.json" else "status", directory)


@pytest.mark.parametrize(
    ("name", "command"), [("run.json", "show"), ("run_plan.json", "resume"), ("agents.csv", "show")]
)
def test_a_file_of_another_run_is_one_line(folders, copied, name, command):
    directory = copied("half" if name == "run_plan.json" else "whole")
    shutil.copy(folders / "other" / name, directory / name)
    line = refused(command, directory)
    assert "was altered or damaged since" in line or "cannot be read: was altered" in line


@pytest.mark.parametrize(
    ("where", "value", "line"),
    [
        (("plan", "members", "none"), 9, "for 9 agents; every shard should have agents"),
        (("plan", "partitions", "none", "shards"), -1, "plan.partitions.none.shards is -1"),
        (("plan", "partitions", "none", "groups"), 2**40, "plan.partitions.none.groups is"),
        (("plan", "partitions", "none", "shard_size"), "2", "plan.partitions.none.shard_size is '2'"),
        (("plan", "partitions"), {}, "plan.partitions is {}"),
        (("plan", "steps"), {"dqn": 0}, "should name the same parts in the same order"),
        (("plan", "steps", "none"), 100, "plan.steps.none is 100; the study has none"),
        (("plan", "agents"), 5, "plan.agents is 5; the parts have 4"),
        (("options", "checkpoint"), "none", "options.checkpoint is 'none'"),
        (("options", "checkpoint_every_s"), -1.0, "options.checkpoint_every_s is -1.0"),
        (("label", "seeds"), [0, 7], "seeds differ from those of the study file"),
        (("label", "places"), {"albany": {}}, "label.places.albany.place is missing"),
        (("versions",), ["jax"], "versions is ['jax']"),
    ],
    ids=lambda value: ".".join(value) if isinstance(value, tuple) else "",
)
def test_a_plan_whose_checksum_is_right_and_whose_contents_are_wrong_is_one_line(copied, where, value, line):
    directory = copied("half")
    facts = json.loads((directory / "run_plan.json").read_text())
    *tables, last = where
    table = facts
    for key in tables:
        table = table[key]
    table[last] = value
    facts["sha256"] = _digest(facts)
    (directory / "run_plan.json").write_text(json.dumps(facts))
    for use in (run_status, resume_run, load_results):
        with pytest.raises(StudyError) as refusal:
            use(directory)
        assert line in str(refusal.value)
        assert "run_plan.json: " in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "value"), [("checkpoint_every_s", float("nan")), ("checkpoint_every_s", -1.0), ("checkpoint_share", 0.0)]
)
def test_options_of_a_run_that_no_plan_may_hold_are_refused(name, value):
    with pytest.raises(um.errors.ArgumentError, match=f"^{name} is "):
        um.runs.RunOptions(**{name: value})

"""The files of a finished run, read back: each with what no run writes, and a SHA-256 that fits or none."""

import hashlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.runs.processes import UNTRAINED
from uavmec_jax.env.dynamics import Cause
from uavmec_jax.errors import StudyError
from uavmec_jax.studies.evaluation_result import EvaluationResult
from uavmec_jax.studies.population import make_agent_ids
from uavmec_jax.studies.results import Results
from uavmec_jax.studies.results_checks import check_curves
from uavmec_jax.studies.results_files import read_results
from uavmec_jax.studies.shard_result import ShardResult
from uavmec_jax.studies.study import parse_study

RESULTS = Path(__file__).parents[2] / "results"
STUDY = parse_study(UNTRAINED, "untrained")
TRAINED = parse_study(UNTRAINED, "untrained", {"algorithm": "a2c"})
LABEL = {
    "schema": 3,
    "study": "untrained",
    "command": "x",
    "started": "now",
    "agents": 4,
    "seeds": [0, 1],
    "partitions": {"none": {"shards": 1, "shard_size": 4, "groups": 1, "shard_bytes": 0}},
}


def shard():
    """The result of all four agents, which live 10 slots in every episode."""
    ids = make_agent_ids(STUDY)
    first = np.zeros((4, 3, 12), np.float32)
    first[..., 3] = 1.0
    cause = np.full((4, 3), Cause.BATTERY, np.int8)
    result = EvaluationResult(lifetime=np.full((4, 3), 10, np.int32), cause=cause, first_failure=first)
    arrays = {f"oldest_first/{name}": array for name, array in vars(result).items() if array is not None}
    rows = pd.DataFrame(ids).assign(**result.columns("oldest-first"))
    return ShardResult("none", rows, {}, arrays, {}, {"wall": 1.0}, 0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    directory = tmp_path_factory.mktemp("whole") / "run"
    Results.of(STUDY, LABEL, [shard()], 4).save(directory)
    return directory


@pytest.fixture
def copied(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "copy")


def refusal(directory):
    """The line with which results are refused, once their SHA-256 fit."""
    run = json.loads((directory / "run.json").read_text())
    run["sha256"] = {
        name: hashlib.sha256((directory / name).read_bytes()).hexdigest()
        for name in run["sha256"]
        if (directory / name).is_file()
    }
    (directory / "run.json").write_text(json.dumps(run))
    with pytest.raises(StudyError) as refused:
        read_results(directory)
    assert str(refused.value).startswith(str(directory))
    return str(refused.value)


def test_results_are_read_as_they_were_written(whole):
    results = read_results(whole)
    assert results.agents["oldest_first_lifetime"].tolist() == [10.0] * 4
    assert results.evaluation["oldest_first/cause"].dtype == np.int8


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("10.0,10", "nan,10", "column oldest_first_lifetime should hold numbers"),
        ("10.0,10", "inf,10", "row 1: oldest_first_lifetime is inf; it should be a finite number"),
        ("10.0,10", "x,10", "column oldest_first_lifetime should hold numbers"),
        ("0,12,8", "7,12,8", "row 1: seed is 7; the study's axis has 0, 1"),
        ("0,12,8", "0,12.5,8", "row 1: powered is 12.5; the study's axis has 12, 4"),
        ("battery", "[/bold]", "oldest_first_cause is '[/bold]'; it should be empty or one of battery, "),
        ("seed,", "sead,", "has no column 'seed'"),
        ("_lifetime,", "_life,", "has no column 'oldest_first_lifetime'"),
        ("\n", ",1\n", "the study does not give"),
        ("\n0,12", "\n0,12,8,1,1,1,1\n0,12", "agents.csv: "),
        ("\n1,4", "\n1,4,8,10,10,battery,battery,4,1,4\n1,4", "it has more rows than the study has agents, 4"),
        ("battery", '"' + "b" * 400_000 + '"', "longer than"),
        ("seed", "\0", "agents.csv: "),
    ],
    ids=lambda value: repr(value[:20]),
)
def test_a_table_with_what_no_run_writes_is_refused(copied, old, new, line):
    path = copied / "agents.csv"
    text = path.read_text().replace(",10.0,10,", ",10.0,10,").replace("8,10,10", "8,10.0,10")
    assert old in text
    path.write_text(text.replace(old, new, 1))
    assert line in refusal(copied)


def test_a_table_that_is_empty_a_pipe_or_a_device_is_refused_at_once(copied):
    path = copied / "agents.csv"
    path.write_bytes(b"")
    assert "No columns to parse" in refusal(copied)
    path.unlink()
    os.mkfifo(path)
    assert "is not a regular file" in refusal(copied)
    path.unlink()
    path.symlink_to("/dev/zero")
    assert "is not a regular file" in refusal(copied)


def nan(arrays):
    arrays["oldest_first/first_failure"][0, 0, 0] = np.nan


def above_one(arrays):
    arrays["oldest_first/first_failure"][0, 0, 0] = 7.0


def unknown_cause(arrays):
    arrays["oldest_first/cause"][2, 1] = 99


def negative(arrays):
    arrays["oldest_first/lifetime"][0, 0] = -1


def broken_numbers(arrays):
    arrays["oldest_first/lifetime"] = arrays["oldest_first/lifetime"] + 0.5


def truth_values(arrays):
    arrays["oldest_first/cause"] = arrays["oldest_first/cause"] > 0


def three_agents(arrays):
    arrays["oldest_first/lifetime"] = arrays["oldest_first/lifetime"][:3]


def missing(arrays):
    del arrays["oldest_first/cause"]


def unknown(arrays):
    arrays["newest_first/lifetime"] = arrays["oldest_first/lifetime"]


def bomb(arrays):
    arrays["oldest_first/lifetime"] = np.zeros((4, 3_000_000), np.int32)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (nan, "'oldest_first/first_failure' holds nan at [1, 1, 1], counted from 1"),
        (above_one, "'oldest_first/first_failure' holds 7.0 at [1, 1, 1]"),
        (unknown_cause, "'oldest_first/cause' holds 99 at [3, 2]"),
        (negative, "'oldest_first/lifetime' holds -1 at [1, 1]"),
        (broken_numbers, "'oldest_first/lifetime' is of type float64; it should hold whole numbers"),
        (truth_values, "'oldest_first/cause' is of type bool; it should hold whole numbers"),
        (three_agents, "'oldest_first/lifetime' has the shape (3, 3); the study gives (4, 3)"),
        (missing, "has no array 'oldest_first/cause'"),
        (unknown, "has the array 'newest_first/lifetime', which the study does not give"),
        (bomb, "bytes unpacked; at most"),
    ],
)
def test_an_evaluation_with_what_no_episode_gives_is_refused(copied, change, line):
    path = copied / "evaluation.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    change(arrays)
    np.savez_compressed(path, **arrays)
    assert line in refusal(copied)


@pytest.mark.parametrize(
    ("name", "value", "line"),
    [
        ("sha256", {"../../victim": "0" * 64}, "sha256 names '../../victim'; known: study.toml, agents.csv"),
        ("sha256", {"agents.csv": 7}, "sha256.agents.csv is 7"),
        ("agents", 5, "complete is true, but agents_done is 4 of 5 agents"),
        ("agents_done", -1, "agents_done is -1"),
        ("complete", "yes", "complete is 'yes'"),
        ("seconds", {"wall": -1.0}, "seconds.wall is -1.0"),
        ("seconds", {}, "seconds.wall is missing"),
        ("seeds", [1, 0], "seeds differ from those of the study file beside it"),
        ("study", "another", "study is 'another'; the study file beside it has 'untrained'"),
        ("places", {"albany": []}, "places.albany is []"),
        ("training_steps_per_second", 10, "environment_steps is missing"),
        ("partitions", None, "partitions is None"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_a_run_json_with_what_no_run_writes_is_refused(copied, name, value, line):
    path = copied / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {name: value}))
    with pytest.raises(StudyError) as refused:
        read_results(copied)
    assert line in str(refused.value)
    assert str(refused.value).startswith(str(path))


def test_curves_that_no_training_gives_are_refused():
    def curves(**changed):
        numbers = {"chunk_steps": np.arange(3), "episode_length": np.full((4, 3), np.nan, np.float32)}
        numbers |= {"validation_steps": np.arange(2), "validation": np.ones((4, 2), np.float32)}
        return {f"a2c/{name}": array for name, array in (numbers | changed).items() if array is not None}

    check_curves(TRAINED, {"a2c": 4}, curves(), "c")
    for changed, line in (
        ({"validation": np.full((4, 2), np.nan, np.float32)}, "'a2c/validation' holds nan at"),
        ({"episode_length": np.full((4, 3), np.inf, np.float32)}, "'a2c/episode_length' holds inf at"),
        ({"episode_length": np.ones((4, 2), np.float32)}, "the study gives"),
        ({"chunk_steps": np.array([0, -1, 2])}, "'a2c/chunk_steps' holds -1 at [2]"),
        ({"chunk_steps": np.array(3)}, "has the shape ()"),
        ({"validation": None}, "has no array 'a2c/validation'"),
    ):
        with pytest.raises(StudyError, match=r"^c: ") as refused:
            check_curves(TRAINED, {"a2c": 4}, curves(**changed), "c")
        assert line in str(refused.value)


def test_a_shard_of_other_agents_is_refused(tmp_path):
    result = shard()
    result.write(tmp_path / "r.npz")
    ids = make_agent_ids(STUDY)
    ShardResult.read(tmp_path / "r.npz").check(STUDY, ids, "r")
    for others in (ids[::-1], ids[:3]):
        with pytest.raises(StudyError, match=r"^r: belongs to another shard: its agents are not those of this one$"):
            result.check(STUDY, others, "r")
    with pytest.raises(StudyError, match=r"^r: belongs to another shard: its algorithm is 'none'$"):
        result.check(TRAINED, ids, "r")


@pytest.mark.parametrize("directory", sorted(RESULTS.rglob("run.json")), ids=lambda path: path.parent.name)
def test_the_committed_results_can_be_read(directory):
    folder = directory.parent
    if not (folder / "evaluation.npz").exists():
        pytest.skip("only its tables are committed")
    assert len(read_results(folder).agents) > 0

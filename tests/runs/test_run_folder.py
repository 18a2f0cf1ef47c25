"""The folder of a run: resumed, damaged, altered, shared."""

import json
import re
import shutil
import socket

import jax
import numpy as np
import pytest

import uavmec_jax as um
from tests.runs.processes import FINAL, TINY, CtrlC, bits, events, stop_after
from uavmec_jax.errors import StudyError
from uavmec_jax.runs import folder as folders
from uavmec_jax.runs import run as running
from uavmec_jax.runs.attempt import Attempt
from uavmec_jax.runs.folder import RunFolder
from uavmec_jax.runs.log import RunLog
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.runs.run import resume_run, run_study
from uavmec_jax.runs.signals import StopSignal
from uavmec_jax.runs.status import run_status
from uavmec_jax.studies.study import parse_study

pytestmark = pytest.mark.slow

STUDY = parse_study(TINY, "tiny")
OFTEN = RunOptions(checkpoint_every_s=0.0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    directory = tmp_path_factory.mktemp("whole") / "run"
    run_study(STUDY, directory, shard_size=2, command="x")
    return directory


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """The first shard is finished, the second one has two checkpoints."""
    directory = tmp_path_factory.mktemp("stopped") / "run"
    results = run_study(STUDY, directory, shard_size=2, command="x", options=OFTEN, on_progress=stop_after(50))
    assert results.run["stopped_by"] == 2
    assert len(results.agents) == 2
    running.resume_run(directory, on_progress=stop_after(6))
    return directory


def copied(directory, tmp_path):
    return shutil.copytree(directory, tmp_path / "copy")


def flip(path, where=0.5):
    data = bytearray(path.read_bytes())
    data[int(len(data) * where)] ^= 1
    path.write_bytes(bytes(data))


def checkpoints(directory):
    return sorted((directory / "shards" / "00001").glob("checkpoint-*.npz"))


def test_a_stopped_run_is_resumed_with_the_same_bits(whole, stopped, tmp_path):
    directory = copied(stopped, tmp_path)
    assert len(checkpoints(directory)) == 2
    results = resume_run(directory)
    assert results.run["complete"]
    assert bits(directory) == bits(whole)
    assert not (directory / "shards").exists()
    assert resume_run(directory).run["complete"]  # nothing is left to do


def test_finished_shards_can_be_shown_before_the_rest(stopped):
    results = load_results(stopped)
    assert (len(results.agents), results.run["complete"]) == (2, False)
    assert results.agents.equals(run_study(STUDY, shard_size=2).agents[:2])  # not rounded as in the table


@pytest.mark.parametrize("damage", [flip, lambda path: path.write_bytes(path.read_bytes()[:-900])], ids=["bit", "end"])
def test_a_damaged_checkpoint_is_reported_and_the_one_before_is_used(whole, stopped, tmp_path, damage):
    directory = copied(stopped, tmp_path)
    older, newest = checkpoints(directory)
    damage(newest)
    resume_run(directory)
    (event,) = events(directory, "damaged")
    assert event["file"] == newest.name
    assert events(directory, "restored")[-1]["file"] == older.name
    assert bits(directory) == bits(whole)


def test_without_an_intact_checkpoint_the_shard_starts_again(whole, stopped, tmp_path):
    directory = copied(stopped, tmp_path)
    before = len(events(directory, "restored"))
    for path in checkpoints(directory):
        flip(path)
    resume_run(directory)
    assert len(events(directory, "damaged")) == 2
    assert len(events(directory, "restored")) == before
    assert bits(directory) == bits(whole)


def test_a_checkpoint_of_another_shard_or_run_is_not_used(whole, stopped, tmp_path):
    directory = copied(stopped, tmp_path)
    other = tmp_path / "other"
    run_study(STUDY, other, command="y", shard_size=2, options=OFTEN, on_progress=stop_after(4))
    (foreign, *_) = sorted((other / "shards" / "00000").glob("checkpoint-*.npz"))
    shutil.copy(foreign, checkpoints(directory)[-1])
    resume_run(directory)
    assert "belongs to another run" in events(directory, "damaged")[0]["error"]
    assert bits(directory) == bits(whole)


@pytest.mark.parametrize("damage", [flip, lambda path: path.write_bytes(path.read_bytes()[:100])], ids=["bit", "end"])
def test_a_damaged_result_is_reported_and_the_shard_runs_again(whole, stopped, tmp_path, damage):
    directory = copied(stopped, tmp_path)
    (result,) = (directory / "shards" / "00000").glob("result-*.npz")
    damage(result)
    with pytest.raises(StudyError, match=r"00000/result-\S+.npz: (cannot be read|was altered|is not a finished)"):
        load_results(directory)
    resume_run(directory)
    assert [(event["shard"], event["file"]) for event in events(directory, "damaged")] == [(0, result.name)]
    assert bits(directory) == bits(whole)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("run_plan.json", r"run_plan\.json: (not JSON|was altered)"),
        ("study.toml", r"study\.toml: was altered or damaged"),
    ],
)
def test_a_damaged_run_plan_is_refused(stopped, tmp_path, name, line):
    directory = copied(stopped, tmp_path)
    path = directory / name
    path.write_bytes(path.read_bytes().replace(b"4000" if name == "study.toml" else b'"agents": 4', b"4001", 1))
    for use in (resume_run, run_status):
        with pytest.raises(StudyError, match=line):
            use(directory)


def test_damaged_logs_reports_and_owners_do_no_harm(whole, stopped, tmp_path):
    directory = copied(stopped, tmp_path)
    (directory / "shards" / "owner.json").write_text('{"machine": "')
    for path in [*(directory / "log").iterdir(), *(directory / "shards").rglob("progress-*.json")]:
        path.write_bytes(path.read_bytes()[:20])
    assert run_status(directory).shards["stopped"] == 1
    resume_run(directory)
    assert bits(directory) == bits(whole)


def test_two_attempts_at_the_same_time_do_no_harm(whole, stopped, tmp_path):
    """A node that was believed dead wakes up: what it writes is what is there already, under another name."""
    directory = copied(stopped, tmp_path)
    folder = RunFolder.open(directory)
    shard = folder.plan.shards[1]
    attempts = [make_attempt(folder, shard) for _ in range(2)]
    training = attempts[0]._checkpoints().resume(attempts[0]._start)
    attempts[1].run()
    attempts[0]._checkpoints().write(training)  # behind the other, which has finished
    attempts[0].run()
    for attempt in attempts:
        attempt.log.close()
    assert len(folder.results(shard)) == 2
    resume_run(directory)
    assert bits(directory) == bits(whole)


def make_attempt(folder, shard):
    runner, log = running.ShardRunner(folder.study, folder.plan), RunLog(folder.path / "log")
    return Attempt(folder, shard, folder.new_attempt(shard), runner, StopSignal(), log)


@pytest.mark.parametrize("name", ["agents.csv", "evaluation.npz", "curves.npz", "run.json"])
def test_a_flipped_bit_in_the_results_is_found(whole, tmp_path, name):
    directory = copied(whole, tmp_path)
    flip(directory / name, 0.4)
    if name == "run.json":
        (directory / name).write_text((directory / name).read_text(errors="replace").replace('"complete"', '"comp', 1))
    with pytest.raises(StudyError, match=r"cannot be read|is missing|not JSON"):
        load_results(directory)


def test_another_schema_of_the_run_plan_is_refused(stopped, tmp_path):
    directory = copied(stopped, tmp_path)
    path = directory / "run_plan.json"
    path.write_text(path.read_text().replace('"schema": 2', '"schema": 7', 1))
    with pytest.raises(StudyError, match=r"run_plan.json: schema is 7; this version reads 2"):
        resume_run(directory)


def test_an_unfinished_run_with_leases_is_refused_and_a_finished_one_is_read(whole, stopped, tmp_path):
    """Runs of versions whose workers held leases: their plans have the number of workers, and schema 1."""
    for name, source in (("finished", whole), ("unfinished", stopped)):
        directory = shutil.copytree(source, tmp_path / name)
        path = directory / "run_plan.json"
        facts = json.loads(path.read_text()) | {"schema": 1}
        facts["plan"]["workers"] = 1
        facts["sha256"] = folders._digest(facts)
        path.write_text(json.dumps(facts))
    assert resume_run(tmp_path / "finished").run["complete"]
    assert run_status(tmp_path / "finished").shards["done"] == 2
    for use in (resume_run, run_status):
        with pytest.raises(
            StudyError, match=r"unfinished: was started by a version whose workers held leases; finish it"
        ):
            use(tmp_path / "unfinished")


def test_other_code_is_refused_unless_it_is_allowed(whole, stopped, tmp_path, monkeypatch):
    directory = copied(stopped, tmp_path)
    monkeypatch.setattr(folders.host, "code_digest", lambda: "0123456789abcdef")
    with pytest.raises(StudyError, match=r"was planned with other code \(uavmec_jax's code \w+ -> 0123456789ab\)"):
        resume_run(directory)
    results = resume_run(directory, other_code=True)
    assert results.run["other_code"]
    assert bits(directory) == bits(whole)


def test_a_second_process_is_refused_with_the_name_of_the_first(tmp_path):
    messages = []

    def second(_):
        for attempt in (lambda: resume_run(tmp_path / "run"), lambda: run_study(STUDY, tmp_path / "run")):
            with pytest.raises(StudyError) as refused:
                attempt()
            messages.append(str(refused.value))
        raise CtrlC

    run_study(STUDY, tmp_path / "run", on_progress=second)
    assert len(messages) == 2
    for line in messages:
        assert re.fullmatch(r"\S+run: process \d+ on \S+ is working in it", line)


def test_an_owner_on_another_machine_is_replaced_when_it_is_said_to_be_dead(whole, stopped, tmp_path):
    directory = copied(stopped, tmp_path)
    (directory / "shards" / "owner.json").write_text('{"machine": "elsewhere 0123", "pid": 7}')
    assert run_status(directory).owner == "process 7 on elsewhere"
    with pytest.raises(StudyError, match=r"process 7 on elsewhere is working in it; if .* dead, give --take-over"):
        resume_run(directory)
    resume_run(directory, take_over=True)
    assert bits(directory) == bits(whole)


def test_a_shard_that_fails_does_not_stop_the_others(whole, tmp_path, monkeypatch):
    start = running.ShardRunner.start

    def broken(self, shard):
        if shard.number == 0:
            raise ZeroDivisionError("by zero")
        return start(self, shard)

    with monkeypatch.context() as patch:
        patch.setattr(running.ShardRunner, "start", broken)
        with pytest.raises(StudyError, match=r"1 of 2 shards failed, shard 0 with ZeroDivisionError: by zero .*resume"):
            run_study(STUDY, tmp_path / "run", command="x", shard_size=2)
    status = run_status(tmp_path / "run")
    assert (status.shards["failed"], status.shards["done"]) == (1, 1)
    assert status.failures == {0: "ZeroDivisionError: by zero"}
    resume_run(tmp_path / "run")
    assert bits(tmp_path / "run") == bits(whole)


def test_checkpoints_of_weights_are_policies_and_the_shard_starts_again(whole, tmp_path):
    light = RunOptions(checkpoint="weights", checkpoint_every_s=0.0, checkpoint_share=1.0)
    run_study(STUDY, tmp_path / "run", command="x", shard_size=2, options=light, on_progress=stop_after(10))
    older, newest = sorted((tmp_path / "run" / "shards" / "00000").glob("checkpoint-*.npz"))
    policy = um.load_policy(newest, seed=0, powered=12)
    layout = um.sample_layout(jax.random.key(0), um.Params(), 12, 8)
    assert 0 <= policy(um.Params(), layout, um.initial_state(um.Params(), layout)) < 12
    assert older.stat().st_size < 300_000
    resume_run(tmp_path / "run")
    assert not events(tmp_path / "run", "restored")
    assert bits(tmp_path / "run") == bits(whole)


@pytest.mark.parametrize("name", ["a b", "täst-ünï-日本", "deep/er/../run", "link"])
def test_a_run_can_have_any_path(whole, tmp_path, name):
    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    run_study(STUDY, tmp_path / name, command="x", shard_size=2, on_progress=stop_after(3))
    resume_run(tmp_path / name)
    assert bits(tmp_path / name) == bits(whole)


def test_the_log_says_what_happened(stopped):
    started = events(stopped, "started")
    assert [event["shard"] for event in started] == [0, 1, 1]
    assert [event["attempt"].split("-")[0] for event in started] == ["01", "01", "02"]
    assert events(stopped, "chunk")[0].keys() == {
        "event", "at", "shard", "steps", "episode_length", "steps_per_second"
    }  # fmt: skip


def test_the_status_tells_where_a_run_stands(stopped):
    status = run_status(stopped)
    assert status.shards == {"waiting": 0, "running": 0, "stopped": 1, "failed": 0, "done": 1}
    assert (status.retries, status.owner, status.running) == (1, "", [])
    assert 0.5 < status.steps / status.total_steps < 1
    report = json.loads(sorted((stopped / "shards" / "00001").glob("progress-*.json"))[-1].read_text())
    assert (report["state"], report["node"]) == ("stopped", socket.gethostname())


def test_results_as_tables(whole):
    results = um.load_results(whole)
    curves, episodes = results.curve_table(), results.episode_table()
    assert curves.columns.tolist() == ["seed", "powered", "connected", "steps", "curve", "value"]
    assert set(curves["curve"]) == {"episode_length", "validation"}
    assert len(curves[curves["curve"] == "validation"]) == 4 * 8
    best = episodes[(episodes["policy"] == "best") & ~episodes["fixed"]]
    mean = best.groupby(["seed", "powered"], sort=False)["lifetime"].mean()
    assert np.allclose(mean, results.agents["best_lifetime"], atol=1e-5)
    assert jax.device_count() == 2


def test_all_files_of_a_run_but_its_labels_and_log_are_compared(whole):
    assert {file.name for file in whole.iterdir()} == {*FINAL, "run.json", "run_plan.json", "log"}
    assert RunFolder.open(whole).complete

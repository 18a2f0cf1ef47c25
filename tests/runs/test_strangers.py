"""What others leave in the folder of a run: copies, notes of file managers, pipes, links; and folders that refuse writes."""

import errno
import os
import shutil

import pytest
from click.testing import CliRunner

from tests.runs.processes import TINY, UNTRAINED, bits, events, stop_after
from uavmec_jax.cli import main
from uavmec_jax.errors import StudyError
from uavmec_jax.files import locks, writing
from uavmec_jax.runs.folder import RunFolder
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.runs.run import resume_run, run_study
from uavmec_jax.runs.status import run_status
from uavmec_jax.studies.study import parse_study

STUDY = parse_study(UNTRAINED, "untrained")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A run of which the first of two shards is finished, and a whole one."""
    top = tmp_path_factory.mktemp("runs")
    run_study(STUDY, top / "half", shard_size=2, command="x", on_progress=stop_after(2))
    run_study(STUDY, top / "whole", shard_size=2, command="x")
    return top


@pytest.fixture
def half(folders, tmp_path):
    return shutil.copytree(folders / "half", tmp_path / "run")


def result_of(directory, shard="00000"):
    (result,) = (directory / "shards" / shard).glob("result-??-??????.npz")
    return result


STRANGERS = (
    "00000/result-01-abcdef (conflicted copy).npz",
    "00001/result-01-abcdef (conflicted copy 2026-11-27).npz",
    "00001/checkpoint-000012-01-abcdef (copy).npz",
    "00001/progress-01-abcdef 2.json",
    "00001/failed (1).json",
    "00001/Failed.json",
    "00001/.DS_Store",
    "00001/Thumbs.db",
    "00001/.~lock.result-01-abcdef.npz#",
    "00001/result-01-abcdef.npz.icloud",
    "00001/[bold] markup\n.txt",
    ".DS_Store",
    "abc/result-01-abcdef.npz",
    "00001 (1)/result-01-abcdef.npz",
    "00002/result-01-abcdef.npz",
    "99999999999999999999999/failed.json",
    "-1/failed.json",
    "owner (conflicted copy).json",
)


def test_names_beside_ours_are_ignored_with_one_warning(folders, half):
    for name in STRANGERS:
        path = half / "shards" / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"\x00 not ours")
    status = run_status(half)
    assert (status.shards["done"], status.shards["failed"], status.retries) == (1, 0, 0)
    assert len(load_results(half).agents) == 2
    assert CliRunner().invoke(main, ["show", str(half)]).exit_code == 0
    (half / "figure.png").mkdir()  # in the way of a file that is made of the others
    done = CliRunner().invoke(main, ["resume", str(half)])
    assert done.stdout.count("ignored, since no run wrote them") == 1
    (event,) = events(half, "ignored")
    expected = {name.split("/")[0] if name.split("/")[0] not in ("00000", "00001") else name for name in STRANGERS}
    assert (event["number"], set(event["names"])) == (len(expected), expected)
    assert not events(half, "damaged")
    assert not events(half, "failed")
    assert bits(half) == bits(folders / "whole")


def pipe(path):
    os.mkfifo(path)


def link_to_a_device(path):
    path.symlink_to("/dev/zero")


def link_to_nowhere(path):
    path.symlink_to("nowhere")


def folder(path):
    path.mkdir()


def other_shard(path):
    shutil.copy(result_of(path.parents[2]), path)


PLANTED = (pipe, link_to_a_device, link_to_nowhere, folder, other_shard)


@pytest.mark.parametrize("plant", PLANTED)
def test_what_is_no_result_and_has_the_name_of_one_is_reported_and_the_shard_runs(folders, half, plant):
    path = half / "shards" / "00001" / "result-01-abcdef.npz"
    path.parent.mkdir(exist_ok=True)
    plant(path)
    with pytest.raises(StudyError, match=r"result-01-abcdef.npz: "):
        load_results(half)
    resume_run(half)
    assert [event["file"] for event in events(half, "damaged")] == [path.name]
    assert bits(half) == bits(folders / "whole")


@pytest.mark.parametrize("name", ["progress-01-abcdef.json", "failed.json"])
@pytest.mark.parametrize("content", ["", "[]", '{"at": "x", "pid": -1, "steps": "many", "state": 7}', "[" * 100_000])
def test_reports_that_are_something_else_do_no_harm(folders, half, name, content):
    path = half / "shards" / "00001" / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(content)
    status = run_status(half)
    assert status.failures == ({1: "an unknown error"} if name == "failed.json" else {})
    resume_run(half)
    assert bits(half) == bits(folders / "whole")


@pytest.mark.parametrize("name", ["shards", "shards/00001", "log", "tensorboard"])
def test_a_link_that_leads_out_of_the_folder_is_refused(half, tmp_path, name):
    victim = tmp_path / "victim"
    victim.mkdir()
    shutil.rmtree(half / name, ignore_errors=True)
    (half / name).symlink_to(victim)
    with pytest.raises(StudyError, match=rf"{name}: is a symbolic link, which is not followed; remove it"):
        resume_run(half)
    assert list(victim.iterdir()) == []


@pytest.mark.slow
def test_copies_and_pipes_beside_the_checkpoints_do_no_harm(tmp_path):
    study, often = parse_study(TINY, "tiny"), RunOptions(checkpoint_every_s=0.0)
    run_study(study, tmp_path / "whole", shard_size=4, command="x")
    run_study(study, tmp_path / "run", shard_size=4, command="x", options=often, on_progress=stop_after(10))
    shard = tmp_path / "run" / "shards" / "00000"
    newest = max(shard.glob("checkpoint-*.npz"))
    (shard / f"checkpoint-999999-{newest.stem[-9:]} (conflicted copy).npz").write_bytes(newest.read_bytes()[:1000])
    os.mkfifo(shard / "checkpoint-999999-01-aaaaaa.npz")
    (shard / "checkpoint-999999-01-bbbbbb.npz").symlink_to("/dev/zero")
    (shard / "checkpoint-999999-01-cccccc.npz").symlink_to("nowhere")
    (shard / "checkpoint-999999-01-dddddd.npz").mkdir()
    shutil.copy(newest, shard / f"checkpoint-999999-{newest.stem[-9:]}.npz")  # renamed: its contents are right
    resume_run(tmp_path / "run")
    planted = {f"checkpoint-999999-01-{letter * 6}.npz" for letter in "abc"}
    assert {event["file"] for event in events(tmp_path / "run", "damaged")} <= planted
    assert len(events(tmp_path / "run", "restored")) == 1
    assert bits(tmp_path / "run") == bits(tmp_path / "whole")


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES, errno.EPERM])
def test_resume_in_a_read_only_folder_is_one_line(half, monkeypatch, number):
    def refuse(self, *_, **__):
        raise OSError(number, os.strerror(number), str(self.lock_file))

    monkeypatch.setattr(locks.FileLock, "acquire", refuse)
    before = sorted(half.rglob("*"))
    done = CliRunner().invoke(main, ["resume", str(half)])
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith(f"uavmec: {half}")
    assert f": cannot be written to: {os.strerror(number)}" in done.stderr
    assert sorted(half.rglob("*")) == before


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_a_full_disk_is_one_line(half, tmp_path, monkeypatch, number):
    def refuse(descriptor):
        raise OSError(number, os.strerror(number))

    (tmp_path / "untrained.toml").write_text(UNTRAINED)
    monkeypatch.setattr(writing.os, "fsync", refuse)
    for arguments in (["resume", half], ["run", tmp_path / "untrained.toml", "--out", tmp_path / "new"]):
        done = CliRunner().invoke(main, [str(argument) for argument in arguments])
        assert (done.exit_code, done.stderr.count("\n")) == (2, 1), done.output
        assert f"cannot be written: {os.strerror(number)}" in done.stderr.replace("written to", "written")
        assert "None" not in done.stderr


def test_a_run_below_a_file_is_one_line(tmp_path):
    (tmp_path / "untrained.toml").write_text(UNTRAINED)
    out = tmp_path / "untrained.toml" / "run"
    done = CliRunner().invoke(main, ["run", str(tmp_path / "untrained.toml"), "--out", str(out)])
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
    assert str(out) in done.stderr


def test_partial_files_of_killed_attempts_are_removed_and_others_stay(half):
    ours, mine = half / "shards" / "00001" / f".failed-{'0' * 16}.part.json", half / "shards" / "abc" / ".x.part.y"
    for path in (ours, mine):
        path.parent.mkdir(exist_ok=True)
        path.touch()
    folder = RunFolder.open(half)
    assert folder.strangers() == ["abc"]
    folder.remove_partial_files()
    assert (ours.exists(), mine.exists()) == (False, True)

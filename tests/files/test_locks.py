"""The lock on a folder: one process at a time, and the next one is told who holds it."""

import json
import subprocess
import sys

import pytest

from tests.runs.processes import environment
from uavmec_jax.errors import StudyError
from uavmec_jax.files import locks
from uavmec_jax.files.locks import OWNER, describe_process, is_known_dead, lock_folder, owner_of, this_process

HOLD = """
import sys, time
from pathlib import Path
from uavmec_jax.files.locks import lock_folder
with lock_folder(Path(sys.argv[1]), Path("run")):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the lock."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True, env=environment()
    )
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_one_at_a_time_in_one_process(tmp_path):
    with lock_folder(tmp_path / "shards", tmp_path):
        assert owner_of(tmp_path / "shards")["pid"] == this_process()["pid"]
        with (
            pytest.raises(StudyError, match=r"process \d+ on \S+ is working in it$"),
            lock_folder(tmp_path / "shards", tmp_path),
        ):
            pass
        assert owner_of(tmp_path / "shards")  # whoever is refused leaves the owner alone
    assert owner_of(tmp_path / "shards") is None
    with lock_folder(tmp_path / "shards", tmp_path):
        pass


def test_a_folder_that_is_a_link_is_refused(tmp_path):
    (tmp_path / "victim").mkdir()
    (tmp_path / "shards").symlink_to("victim")
    message = rf"^{tmp_path}/shards: is a symbolic link, which is not followed; remove it$"
    with pytest.raises(StudyError, match=message), lock_folder(tmp_path / "shards", tmp_path):
        pass
    assert list((tmp_path / "victim").iterdir()) == []


def test_another_process_is_named_and_its_death_frees_the_folder(tmp_path, holder):
    for take_over in (False, True):  # a process that is alive here is not replaced
        with (
            pytest.raises(StudyError, match=f"process {holder.pid} on"),
            lock_folder(tmp_path, tmp_path, take_over=take_over),
        ):
            pass
    holder.kill()
    holder.wait()
    assert owner_of(tmp_path) is None
    with lock_folder(tmp_path, tmp_path):
        assert owner_of(tmp_path)["pid"] == this_process()["pid"]


def test_an_owner_on_another_machine_stays_until_it_is_replaced(tmp_path):
    (tmp_path / OWNER).write_text(json.dumps({"machine": "elsewhere 1", "pid": 3, "token": "t"}))
    with (
        pytest.raises(StudyError, match=r"process 3 on elsewhere is working in it; .*--take-over"),
        lock_folder(tmp_path, tmp_path),
    ):
        pass
    with lock_folder(tmp_path, tmp_path, take_over=True):
        # it was only asleep, and replaces us in turn; leaving, we leave its file alone
        (tmp_path / OWNER).write_text(json.dumps({"machine": "elsewhere 1", "pid": 3, "token": "t"}))
    assert owner_of(tmp_path)["pid"] == 3


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff\xfe"])
def test_a_damaged_owner_is_replaced(tmp_path, content):
    (tmp_path / OWNER).write_bytes(content)
    with lock_folder(tmp_path, tmp_path):
        assert owner_of(tmp_path)


def test_without_locks_of_the_system_the_owner_stands_in(tmp_path, monkeypatch):
    monkeypatch.setattr(locks, "_acquire", lambda folder, of: None)
    with (
        lock_folder(tmp_path, tmp_path),
        pytest.raises(StudyError, match="is working in it"),
        lock_folder(tmp_path, tmp_path),
    ):
        pass
    with lock_folder(tmp_path, tmp_path):
        pass


def test_a_folder_that_is_removed_while_it_is_held(tmp_path):
    with lock_folder(tmp_path / "shards", tmp_path):
        for file in (tmp_path / "shards").iterdir():
            file.unlink()
        (tmp_path / "shards").rmdir()
    assert not (tmp_path / "shards").exists()


def test_a_reused_process_number_is_no_owner(monkeypatch):
    process = this_process()
    assert not is_known_dead(process)
    monkeypatch.setattr(locks, "_born", lambda pid: "another")
    assert is_known_dead(process)
    assert not is_known_dead(process | {"machine": "elsewhere 1"})


@pytest.mark.parametrize("pid", ["x", 10**30, -1, True, None, 1.5])
def test_an_owner_with_a_number_that_no_process_has_is_dead(tmp_path, pid):
    (tmp_path / OWNER).write_text(json.dumps({"machine": locks.this_machine(), "pid": pid}))
    assert owner_of(tmp_path) is None


@pytest.mark.parametrize("owner", [{}, {"machine": ""}, {"machine": None}, {"machine": " "}])
def test_an_owner_that_names_no_machine(owner):
    assert describe_process(owner) == "process ? on an unknown machine"

"""The log of a run: JSON lines, what happens when they cannot be written, and TensorBoard's event files."""

import json
import os
import resource
import socket
import sys

import pytest

from uavmec_jax.errors import StudyError
from uavmec_jax.runs.log import RunLog


def read_lines(folder) -> list[dict]:
    return [json.loads(line) for file in folder.iterdir() for line in file.read_text(encoding="utf-8").splitlines()]


def read_scalars(folder) -> dict[str, list[float]]:
    """Read the scalars of TensorBoard's event files by tag; a record is its length, a CRC, the event and another CRC."""
    from tensorboardX.proto.event_pb2 import Event

    (file,) = folder.iterdir()
    data, values = file.read_bytes(), {}
    while data:
        length = int.from_bytes(data[:8], "little")
        for value in Event.FromString(data[12 : 12 + length]).summary.value:
            values.setdefault(value.tag, []).append(value.simple_value)
        data = data[16 + length :]
    return values


@pytest.fixture
def events():
    return []


@pytest.fixture
def log(tmp_path, events):
    log = RunLog(tmp_path / "log", on_event=lambda event, facts: events.append((event, facts)))
    yield log
    log.close()


def test_every_event_is_one_line_of_json(tmp_path, log, events):
    assert not (tmp_path / "log").exists()  # nothing is written before the first event
    facts = {"shard": 3, "error": 'täst: "a"\nb\u2028c %s', "seconds": {"train": 0.5}, "taken_over": True, "none": None}
    log.event("claimed", **facts)
    log.event("100% done")
    log.curve(3, 600, episode_length=20.5)
    (file,) = (tmp_path / "log").iterdir()
    assert file.name == f"{socket.gethostname()}-{os.getpid()}.jsonl"
    assert file.read_bytes().count(b"\n") == 3
    lines = read_lines(tmp_path / "log")
    assert [line.pop("at") > 1.7e9 for line in lines] == [True] * 3
    assert lines == [
        {"event": "claimed", **facts},
        {"event": "100% done"},
        {"event": "chunk", "shard": 3, "steps": 600, "episode_length": 20.5},
    ]
    assert events == [(line.pop("event"), line) for line in lines]


def test_a_closed_log_is_appended_to(tmp_path, log):
    log.event("first")
    log.close()
    log.event("second")
    assert [line["event"] for line in read_lines(tmp_path / "log")] == ["first", "second"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="Linux only")
def test_a_full_disk_stops_neither_the_run_nor_on_event(tmp_path, log, events, capfd):
    (tmp_path / "log").mkdir()
    (tmp_path / "log" / f"{socket.gethostname()}-{os.getpid()}.jsonl").symlink_to("/dev/full")
    log.event("claimed", shard=0)
    log.event("done", shard=0)
    log.close()
    assert [event for event, _ in events] == ["claimed", "done"]
    assert capfd.readouterr() == ("", "")


def test_once_the_disk_has_space_again_lines_are_whole(tmp_path, log):
    """A limit on the size of files stands in for a full disk."""
    log.event("before")
    (file,) = (tmp_path / "log").iterdir()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file.stat().st_size, hard))
        log.event("lost")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    log.event("after")
    assert [line["event"] for line in read_lines(tmp_path / "log")] == ["before", "after"]


def test_a_folder_that_cannot_be_created_stops_neither_the_run_nor_on_event(tmp_path, log, events, capfd):
    (tmp_path / "log").write_text("a file")
    log.event("claimed", shard=0)
    log.close()
    assert events == [("claimed", {"shard": 0})]
    assert capfd.readouterr() == ("", "")


def test_curves_are_written_as_event_files_of_tensorboard(tmp_path, events):
    log = RunLog(tmp_path / "log", tensorboard=True, on_event=lambda event, facts: events.append(event))
    log.event("claimed", shard=1)
    assert not (tmp_path / "tensorboard").exists()
    for shard, steps in ((1, 100), (2, 100), (1, 200)):
        log.curve(shard, steps, episode_length=shard + steps, validation=0.5)
    log.close()
    assert read_scalars(tmp_path / "tensorboard" / "shard-00001") == {
        "episode_length": [101.0, 201.0],
        "validation": [0.5, 0.5],
    }
    assert read_scalars(tmp_path / "tensorboard" / "shard-00002") == {"episode_length": [102.0], "validation": [0.5]}
    assert [line["event"] for line in read_lines(tmp_path / "log")] == events == ["claimed", "chunk", "chunk", "chunk"]


def test_without_tensorboardx_the_log_is_refused_at_once(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(StudyError, match=r"--tensorboard needs the package tensorboardX, which is not installed"):
        RunLog(tmp_path / "log", tensorboard=True)

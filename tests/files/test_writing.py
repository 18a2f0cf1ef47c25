"""Atomic writes and readers."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from uavmec_jax.errors import StudyError
from uavmec_jax.files import writing
from uavmec_jax.files.archives import load_arrays
from uavmec_jax.files.parsing import parse_toml
from uavmec_jax.files.reading import read_json_or_empty, read_text
from uavmec_jax.files.writing import atomic, write_arrays, write_text


def test_a_file_is_replaced_and_nothing_else_is_left(tmp_path):
    path = tmp_path / "x.txt"
    for text in ("old", "new é"):
        write_text(path, text)
        assert read_text(path, StudyError) == text
    write_arrays(tmp_path / "x.npz", {"a": np.arange(3)}, compressed=False)
    assert_array_equal(load_arrays(tmp_path / "x.npz")["a"], [0, 1, 2])
    assert sorted(file.name for file in tmp_path.iterdir()) == ["x.npz", "x.txt"]


def test_after_an_error_the_file_is_as_before(tmp_path):
    path = tmp_path / "x.txt"
    write_text(path, "old")

    def fail():
        with atomic(path) as partial:
            assert partial.suffix == ".txt"
            assert partial.parent == tmp_path
            partial.write_text("half")
            raise RuntimeError("disk")

    with pytest.raises(RuntimeError, match="disk"):
        fail()
    assert [file.read_text() for file in tmp_path.iterdir()] == ["old"]


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    path = tmp_path / "x.txt"
    with pytest.raises(StudyError, match=r"x\.txt: cannot be read: No such file"):
        read_text(path, StudyError)
    path.write_bytes(b"\xff")
    with pytest.raises(StudyError, match=r"x\.txt: cannot be read: byte 1 is not UTF-8; save the file as UTF-8"):
        read_text(path, StudyError)
    with pytest.raises(StudyError, match=r"x\.toml: not TOML: Invalid value"):
        parse_toml("a = ", "x.toml", StudyError)
    assert parse_toml("a = 1", "x.toml", StudyError) == {"a": 1}


@pytest.mark.parametrize(("content", "result"), [('{"a": 1}', {"a": 1}), ("[1]", {}), ("{", {}), (None, {})])
def test_json_that_may_be_incomplete(tmp_path, content, result):
    path = tmp_path / "x.json"
    if content is not None:
        path.write_text(content)
    assert read_json_or_empty(path) == result


def test_a_planted_link_is_replaced_and_not_followed(tmp_path):
    victim, path = tmp_path / "victim", tmp_path / "x.txt"
    victim.write_text("precious")
    path.symlink_to(victim)
    write_text(path, "new")
    assert victim.read_text() == "precious"
    assert path.read_text() == "new"
    assert not path.is_symlink()


def test_a_temporary_name_that_is_taken_is_not_written_to(tmp_path, monkeypatch):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    monkeypatch.setattr(writing.secrets, "token_hex", lambda _: "guessed")
    (tmp_path / ".x-guessed.part.txt").symlink_to(victim)
    with pytest.raises(FileExistsError):
        write_text(tmp_path / "x.txt", "new")
    assert victim.read_text() == "precious"
    assert not (tmp_path / "x.txt").exists()


def test_a_device_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/null")):
        with pytest.raises(OSError, match="is not a regular file"):
            write_text(path, "new")
    with pytest.raises(IsADirectoryError):
        write_text(tmp_path, "new")
    assert Path("/dev/null").is_char_device()
    assert os.listdir(tmp_path) == ["pipe"]


def test_a_long_name_leaves_room_for_the_temporary_one(tmp_path):
    path = tmp_path / ("x" * 251 + ".txt")
    write_text(path, "new")
    assert os.listdir(tmp_path) == [path.name]


_WRITER = """
import sys
from pathlib import Path
from uavmec_jax.files.writing import write_text
path, letter = Path(sys.argv[1]), sys.argv[2]
for _ in range(60):
    write_text(path, letter * 300_000)
"""


@pytest.mark.slow
def test_a_file_is_whole_under_two_writers_and_a_reader(tmp_path):
    path = tmp_path / "x.txt"
    writers = [subprocess.Popen([sys.executable, "-P", "-c", _WRITER, path, letter]) for letter in "ab"]
    reads = 0
    while any(writer.poll() is None for writer in writers):
        if path.exists():
            text = read_text(path, StudyError)
            assert text in ("a" * 300_000, "b" * 300_000)
            reads += 1
    assert [writer.returncode for writer in writers] == [0, 0]
    assert reads > 10
    assert os.listdir(tmp_path) == ["x.txt"]

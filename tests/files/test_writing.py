"""Atomic writes and readers."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from uavmec_jax.errors import StudyError
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

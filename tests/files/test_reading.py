"""Readers: regular files alone, no longer than they may be, each fault in one line."""

import hashlib
import os

import pytest

from uavmec_jax.errors import StudyError
from uavmec_jax.files.locations import local_path, to_path
from uavmec_jax.files.reading import digest_of, open_regular, read_bytes, read_json_or_empty, read_text, size_in_words


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "x.toml"
    path.write_bytes(b"a = 1\r\n")
    return path


def test_a_file_is_read(file):
    assert read_bytes(file, StudyError) == b"a = 1\r\n"
    assert read_text(file, StudyError) == "a = 1\n"
    assert digest_of(file, StudyError) == hashlib.sha256(b"a = 1\r\n").hexdigest()


def test_a_fifo_is_refused_at_once(tmp_path):
    path = tmp_path / "x.toml"
    os.mkfifo(path)
    for read in (read_text, read_bytes, digest_of):
        with pytest.raises(StudyError, match=r"x\.toml: cannot be read: is not a regular file$"):
            read(path, StudyError)
    assert read_json_or_empty(path) == {}


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/null", "/dev/stdin"])
def test_a_device_file_is_refused_at_once(tmp_path, device):
    path = tmp_path / "x.toml"
    path.symlink_to(device)
    with pytest.raises(StudyError, match=r"x\.toml: cannot be read: "):
        read_text(path, StudyError)


def test_a_folder_is_refused(tmp_path):
    with pytest.raises(StudyError, match=r"cannot be read: Is a directory$"):
        read_text(tmp_path, StudyError)


def test_a_file_that_is_too_long_is_refused(file):
    assert read_bytes(file, StudyError, max_bytes=7) == b"a = 1\r\n"
    with pytest.raises(StudyError, match=r"x\.toml: is longer than 6 bytes, the most that such a file may have$"):
        read_text(file, StudyError, max_bytes=6)


@pytest.mark.parametrize("name", ["a\0b", "x" * 5000, "x/" * 5000], ids=["NUL", "long name", "long path"])
def test_a_name_that_no_file_can_have_is_refused(tmp_path, name):
    with pytest.raises(StudyError, match=r"cannot be read: |NUL") as error:
        read_text(tmp_path / name, StudyError)
    assert len(str(error.value)) <= 400


def test_a_nul_in_a_location_is_refused():
    for convert in (to_path, lambda path: local_path(path, "a search")):
        with pytest.raises(
            StudyError, match=r"a\\x00b: contains a NUL character, which no path can contain; give another path"
        ):
            convert("a\0b")


def test_text_that_is_not_utf_8_is_refused_with_its_byte(tmp_path):
    path = tmp_path / "x.csv"
    path.write_bytes("name\nŁódź".encode("utf-16"))
    with pytest.raises(StudyError, match=r"x\.csv: cannot be read: byte 1 is not UTF-8; save the file as UTF-8"):
        read_text(path, StudyError)


@pytest.mark.parametrize("content", ["[" * 200_000, "9" * 5000, '{"a": '], ids=["depth", "digits", "truncated"])
def test_damaged_json_of_another_process_is_empty(tmp_path, content):
    path = tmp_path / "x.json"
    path.write_text(content)
    assert read_json_or_empty(path) == {}


def test_no_descriptor_stays_open_after_a_refusal(tmp_path):
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        with pytest.raises(IsADirectoryError):
            open_regular(tmp_path)
    assert len(os.listdir("/proc/self/fd")) == before


def test_sizes_in_words():
    assert [size_in_words(n) for n in (5, 2048, 2**20, 3 * 2**30)] == ["5 bytes", "2 KiB", "1 MiB", "3 GiB"]

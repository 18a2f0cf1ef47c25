"""Paths and URLs: what is read and written is the same, in a folder and in a store in memory."""

import errno
import json
from pathlib import Path

import fsspec
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from uavmec_jax.errors import PolicyError, StudyError
from uavmec_jax.files import locations, locks
from uavmec_jax.files.archives import load_arrays, read_checked, write_checked
from uavmec_jax.files.locations import (
    StoreError,
    absolute,
    files_in_subfolders,
    is_local,
    is_url,
    local_copy,
    local_path,
    make_folder,
    names_in,
    reached,
    remove_folder,
    store_errors,
    to_path,
)
from uavmec_jax.files.locks import OWNER, describe_process, lock_folder, owner_of, this_process
from uavmec_jax.files.reading import read_json_or_empty, read_text
from uavmec_jax.files.writing import atomic, create_exclusively, set_aside, write_arrays, write_text


@pytest.fixture(params=["folder", "memory"])
def place(request, tmp_path):
    """A folder that does not exist yet."""
    if request.param == "folder":
        yield tmp_path / "x"
        return
    store = fsspec.filesystem("memory")
    store.rm("/", recursive=True)
    yield to_path("memory://tests/x")
    store.rm("/", recursive=True)


def test_locations():
    assert to_path("runs/a") == to_path(Path("runs/a")) == Path("runs/a")
    assert to_path("file:///tmp/a") == Path("/tmp/a")
    assert is_local(to_path("C:/runs/a"))
    url = to_path("memory://tests/x/")
    assert not is_local(url)
    assert (str(url), str(url / "a.b"), (url / "a.b").suffix) == ("memory://tests/x", "memory://tests/x/a.b", ".b")
    assert to_path(url) == url
    assert (absolute(url), absolute(Path("a"))) == ("memory://tests/x", str(Path.cwd() / "a"))
    assert [is_url(text) for text in ("s3://b", "a/b", "file:///b", url, Path("a"))] == [
        True,
        False,
        False,
        True,
        False,
    ]


def test_a_path_that_was_a_url_is_refused():
    with pytest.raises(StudyError, match=r"s3:/bucket/run: looks like a URL that has lost a slash"):
        to_path(Path("s3://bucket/run"))
    with pytest.raises(StudyError, match=r"s3://bucket/a: the database of a search cannot be in an object store"):
        local_path("s3://bucket/a", "the database of a search")


def test_unknown_protocols_and_missing_packages(monkeypatch):
    with pytest.raises(StudyError, match=r"^nothing://a/b: Unsupported filesystem: 'nothing'$"):
        to_path("nothing://a/b")

    def no_module(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(locations.importlib, "import_module", no_module)
    with pytest.raises(PolicyError, match=r"No module named 'upath'\): pip install 'uavmec-jax\[cloud\]'$"):
        to_path("memory://a/b", PolicyError)
    assert to_path("a/b") == Path("a/b")


def test_files_are_written_whole_and_read_again(place):
    make_folder(place)
    for text in ("old", "new é"):
        write_text(place / "a.txt", text)
        assert read_text(place / "a.txt", StudyError) == text
    write_arrays(place / "a.npz", {"a": np.arange(3)})
    assert_array_equal(load_arrays(place / "a.npz")["a"], [0, 1, 2])
    write_checked(place / "b.npz", 1, {"fact": 1}, {"a": np.arange(3)})
    header, arrays = read_checked(place / "b.npz", 1, "a test", StudyError)
    assert header["fact"] == 1
    assert list(arrays) == ["a"]
    with local_copy(place / "a.txt") as local:
        assert is_local(local)
        assert local.read_text(encoding="utf-8") == "new é"
    assert sorted(file.name for file in place.iterdir()) == ["a.npz", "a.txt", "b.npz"]
    remove_folder(place)
    assert not place.exists()
    remove_folder(place)


def test_after_an_error_the_file_is_as_before(place):
    make_folder(place)
    write_text(place / "a.txt", "old")

    def fail():
        with atomic(place / "a.txt") as partial:
            partial.write_text("half")
            raise RuntimeError("disk")

    with pytest.raises(RuntimeError, match="disk"):
        fail()
    assert [file.read_text() for file in place.iterdir()] == ["old"]


def test_missing_and_damaged_files(place):
    make_folder(place)
    with pytest.raises(StudyError, match=r"x/a\.txt: cannot be read: No such file or directory$"):
        read_text(place / "a.txt", StudyError)
    with pytest.raises(StudyError, match=r"x/a\.npz: cannot be read: No such file or directory$"):
        load_arrays(place / "a.npz")
    assert read_json_or_empty(place / "a.json") == {}
    write_text(place / "a.npz", "damaged")
    with pytest.raises(StudyError, match=r"x/a\.npz: cannot be read: "):
        read_checked(place / "a.npz", 1, "a test", StudyError)
    set_aside(place / "a.npz")
    set_aside(place / "a.npz")
    assert [file.name for file in place.iterdir()] == ["a.damaged"]


def test_files_of_a_folder_by_name(place):
    assert names_in(place) == []
    make_folder(place / "b")
    for name in ("a-2.npz", "a-1.npz", "a-1.json", "b/a-3.npz"):
        write_text(place / name, "")
    assert names_in(place) == ["a-1.json", "a-1.npz", "a-2.npz", "b"]


def test_files_in_subfolders(place):
    assert list(files_in_subfolders(place)) == []
    for name in ("b/1", "b/2", "c/1"):
        make_folder(place / name[0])
        write_text(place / name, "")
    write_text(place / "a", "")
    files = sorted(files_in_subfolders(place), key=str)
    assert [(file.parent.name, file.name) for file in files] == [("b", "1"), ("b", "2"), ("c", "1")]


def test_of_several_processes_one_creates_a_file(place):
    make_folder(place)
    assert create_exclusively(place / "a", b"first")
    assert not create_exclusively(place / "a", b"second")
    assert (place / "a").read_bytes() == b"first"


def test_what_cannot_be_written_to(monkeypatch):
    """Some file systems only read, such as that of web pages."""

    def fail(*_, **__):
        raise NotImplementedError

    with reached("memory://tests/x") as path:
        monkeypatch.setattr(type(path.fs), "pipe_file", fail)
    refused = r"^memory://tests/x: cannot be written to$"
    with pytest.raises(StudyError, match=refused), reached("memory://tests/x") as path:
        create_exclusively(path / "a", b"")


def test_errors_of_stores_are_those_of_file_systems():
    error = type("ConnectError", (Exception,), {"__module__": "botocore.exceptions"})
    with pytest.raises(StoreError, match=r"^two lines$"), store_errors():
        raise error("two\n  lines")
    with pytest.raises(StudyError, match=r"^memory://tests/x: two lines$"), reached("memory://tests/x"):
        raise error("two lines")
    with (
        pytest.raises(PolicyError, match=r"^memory://tests/x: ConnectError$"),
        reached("memory://tests/x", PolicyError),
    ):
        raise error
    with pytest.raises(KeyError), reached("memory://tests/x"):
        raise KeyError
    with pytest.raises(OSError, match="full"), reached("folder"):  # local errors are as they were
        raise OSError(errno.ENOSPC, "full")


def test_a_file_that_cannot_be_reached_is_not_damaged(monkeypatch):
    path = to_path("memory://tests/x/a.npz")

    def fail(*_):
        raise PermissionError("Access Denied")

    monkeypatch.setattr(type(path.fs), "get_file", fail)
    with pytest.raises(StoreError, match="Access Denied"):
        read_checked(path, 1, "a test", StudyError)


def test_a_folder_has_one_owner(place, monkeypatch):
    with lock_folder(place, place):
        assert owner_of(place)["pid"] == this_process()["pid"]
        refused = f"x: {describe_process(this_process())} is working in it"
        with pytest.raises(StudyError, match=refused), lock_folder(place, place):
            pass
        assert owner_of(place) is not None
    assert not (place / OWNER).exists()
    (place / OWNER).write_text(json.dumps(this_process() | {"born": "long ago"}))  # its process is dead
    assert owner_of(place) is None
    with lock_folder(place, place):
        pass


def test_an_owner_on_another_machine_is_replaced_on_request(place):
    make_folder(place)
    write_text(place / OWNER, json.dumps(this_process() | {"machine": "elsewhere 1", "token": "theirs"}))
    refused = r"x: process \d+ on elsewhere is working in it; if that process is dead, give --take-over$"
    with pytest.raises(StudyError, match=refused), lock_folder(place, place):
        pass
    with lock_folder(place, place, take_over=True):
        assert owner_of(place)["machine"] == this_process()["machine"]
        write_text(place / OWNER, json.dumps({"token": "of one that took over in turn"}))
    assert (place / OWNER).exists()


def test_a_store_that_answers_twice(monkeypatch):
    """A request that is repeated after a lost answer finds the object that it has made itself."""
    place = to_path("memory://tests/twice")

    def create(path, content):
        assert create_exclusively(path, content)
        return False

    monkeypatch.setattr(locks, "create_exclusively", create)
    with lock_folder(place, place):
        pass

"""Where files are: a path of this machine, or a URL of an object store (``s3://``, ``gs://``, ...) as a path-like object.

Code that is given a path must not care which, except here, in :mod:`locks` and in :mod:`writing`. What the packages of
stores raise becomes an :class:`OSError`, as on a local file system (:func:`store_errors`).
"""

import errno
import importlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

from uavmec_jax.errors import StudyError, UserError

_URL = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)
_COLLAPSED_URL = re.compile(r"[a-z][a-z0-9+.-]+:[/\\]", re.IGNORECASE)
_LOCAL_URL = "file://"

_CACHING = ("s3", "s3a", "gs", "gcs")
"""Protocols whose packages keep listings of folders, which lack the files that other processes write later."""

_PACKAGES = ("aiobotocore", "aiohttp", "botocore", "fsspec", "gcsfs", "google", "s3fs")
"""Packages of stores, whose errors mean that a store cannot be reached or refuses."""


class StoreError(OSError):
    """An object store cannot be reached, or refuses; what it holds is as before."""


def is_url(location: object) -> bool:
    """Return whether a location is the URL of a store, not a path of this machine."""
    text = str(location)
    return bool(_URL.match(text)) and not text.lower().startswith(_LOCAL_URL)


def to_path(location: str | Path, error: type[UserError] = StudyError) -> Path:
    """Return a location as a path: a :class:`pathlib.Path`, or for a URL an object that can do the same.

    Raises:
        UserError: it holds a NUL character or is too long; for a URL, if universal-pathlib or the store's own package is not
            installed, the protocol is unknown, or the URL was made a :class:`pathlib.Path`, which drops a slash; of the type
            ``error``.
    """
    text = str(location)
    if "\0" in text:
        raise error(f"{text}: contains a NUL character, which no path can contain; give another path")
    if not is_url(text):
        if isinstance(location, Path) and _COLLAPSED_URL.match(text):
            raise error(f"{text}: looks like a URL that has lost a slash as a pathlib.Path; give it as text")
        path = Path(text[len(_LOCAL_URL) :] if _URL.match(text) else location)
        _check_length(path, error)
        return path
    options = {"use_listings_cache": False} if text.partition(":")[0].lower() in _CACHING else {}
    try:
        upath = importlib.import_module("upath")
        path = upath.UPath(location, **options)  # of an object like ours, it keeps the options
        path.fs  # noqa: B018 (imports the package of the store)
    except ImportError as problem:
        needed = f"needs a package that is not installed ({problem}): pip install 'uavmec-jax[cloud]'"
        raise error(f"{text}: {needed}") from None
    except ValueError as problem:
        raise error(f"{text}: {problem}") from None
    return cast(Path, path)


def _check_length(path: Path, error: type[UserError]) -> None:
    try:
        path.lstat()
    except OSError as problem:
        if problem.errno == errno.ENAMETOOLONG:
            raise error(f"{str(path)[:60]}...: {reason_of(problem)}; give a shorter path") from None


def local_path(location: str | Path, needed_by: str) -> Path:
    """Return a location as a path of this machine.

    Raises:
        StudyError: it is the URL of a store; ``needed_by`` says what cannot be there.
    """
    if is_url(location):
        raise StudyError(f"{location}: {needed_by} cannot be in an object store; give a folder of this machine")
    return to_path(location)


@contextmanager
def reached(location: str | Path, error: type[UserError] = StudyError) -> Iterator[Path]:
    """Yield a location as a path. If it is a URL, whatever goes wrong with its store inside becomes a user's error.

    Raises:
        UserError: as :func:`to_path`; the store cannot be reached, refuses, or has no such bucket; of the type ``error``.
    """
    path = to_path(location, error)
    if is_local(path):
        yield path
        return
    try:
        with store_errors():
            yield path
    except OSError as problem:
        raise error(f"{path}: {reason_of(problem)}") from problem


@contextmanager
def store_errors() -> Iterator[None]:
    """Turn what the packages of stores raise into a :class:`StoreError`.

    Raises:
        StoreError: a store cannot be reached, refuses, or cannot be written to.
    """
    try:
        yield
    except Exception as error:
        if type(error).__module__.partition(".")[0] in _PACKAGES:
            raise StoreError(" ".join(str(error).split()) or type(error).__name__) from error
        raise


def reason_of(error: OSError) -> str:
    """Return the reason of an error in words; stores give no error number."""
    return error.strerror or str(error) or type(error).__name__


def is_local(path: Path) -> bool:
    """Return whether a path is one of this machine's file systems, mounted ones included."""
    return isinstance(path, Path)


def absolute(path: Path) -> str:
    """Return a path as text that means the same in another process."""
    return os.path.abspath(path) if is_local(path) else str(path)


def check_no_link(folder: Path) -> None:
    """Refuse a folder that is a symbolic link: what is written there would go elsewhere.

    Raises:
        StudyError: it is one.
    """
    if is_local(folder) and folder.is_symlink():
        raise StudyError(f"{folder}: is a symbolic link, which is not followed; remove it")


def make_folder(path: Path) -> None:
    """Create a folder, unless there is one. In a store it comes with its first file, and a bucket is not created."""
    if is_local(path):
        path.mkdir(parents=True, exist_ok=True)


def remove_folder(path: Path) -> None:
    """Remove a folder and everything in it; whatever is in the way is left."""
    if is_local(path):
        shutil.rmtree(path, ignore_errors=True)
        return
    with suppress(OSError), store_errors():
        file_system(path).rm(path_in_store(path), recursive=True)


def names_in(folder: Path) -> list[str]:
    """Return the sorted names of the files and folders in a folder; none if it does not exist.

    Of a store, ``glob`` and ``is_file`` hide what goes wrong: then there is no file. Listing and ``exists`` do not.
    """
    if is_local(folder):
        return sorted(file.name for file in folder.iterdir()) if folder.is_dir() else []
    top = path_in_store(folder)
    try:
        with store_errors():
            names = {name.removeprefix(top).strip("/") for name in file_system(folder).ls(top, detail=False)}
    except FileNotFoundError:
        return []
    return sorted(names - {""})  # the empty object by which consoles of stores show a folder


def files_in_subfolders(folder: Path) -> Iterable[Path]:
    """Return the files in all folders of a folder; none if it does not exist."""
    if is_local(folder):
        return folder.glob("*/*")
    top = path_in_store(folder)
    with store_errors():  # one request for every thousand files, instead of one for every folder
        found = [name.removeprefix(top).strip("/") for name in file_system(folder).find(top)]
    return [folder / name for name in found if name.count("/") == 1]


@contextmanager
def local_copy(path: Path) -> Iterator[Path]:
    """Yield a path of this machine where a file can be read, for as long as it is needed: a copy if it is in a store.

    Raises:
        FileNotFoundError: there is no such file in the store.
        StoreError: the store cannot be reached, or refuses.
    """
    if is_local(path):
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="uavmec-") as folder:
        copy = Path(folder) / path.name
        try:
            with store_errors():
                file_system(path).get_file(path_in_store(path), str(copy))
        except FileNotFoundError:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path)) from None
        except OSError as error:
            raise StoreError(reason_of(error)) from error
        yield copy


def file_system(path: Path) -> Any:
    """Return the fsspec file system of a path that is not local."""
    return path.fs  # type: ignore[attr-defined]


def path_in_store(path: Path) -> str:
    """Return a path that is not local as its file system takes it."""
    return str(path.path)  # type: ignore[attr-defined]

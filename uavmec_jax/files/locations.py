"""Where files are: a path of this machine, or a URL of an object store (``s3://``, ``gs://``, ...) as a path-like object."""

import importlib
import os
import re
import shutil
from pathlib import Path
from typing import Any, cast

from uavmec_jax.errors import StudyError

_URL = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)


def to_path(location: str | Path) -> Path:
    """Return a location as a path: a :class:`pathlib.Path`, or for a URL an object that can do the same.

    Raises:
        StudyError: for a URL, if universal-pathlib or the store's own package is not installed, or the protocol is unknown.
    """
    if not isinstance(location, str) or not _URL.match(location):
        return Path(location) if isinstance(location, str) else location
    try:
        upath = importlib.import_module("upath")
        path = upath.UPath(location)
        path.fs  # noqa: B018 (imports the package of the store)
    except ImportError as error:
        needed = f"needs a package that is not installed ({error}): pip install 'uavmec-jax[cloud]'"
        raise StudyError(f"{location}: {needed}") from None
    except ValueError as error:
        raise StudyError(f"{location}: {error}") from None
    return cast(Path, path)


def is_local(path: Path) -> bool:
    """Return whether a path is one of this machine's file systems, mounted ones included."""
    return isinstance(path, Path)


def absolute(path: Path) -> str:
    """Return a path as text that means the same in another process."""
    return os.path.abspath(path) if is_local(path) else str(path)


def remove_folder(path: Path) -> None:
    """Remove a folder and everything in it; whatever is in the way is left."""
    if is_local(path):
        shutil.rmtree(path, ignore_errors=True)
        return
    store = file_system(path)
    if store.exists(str(path.path)):  # type: ignore[attr-defined]
        store.rm(path.path, recursive=True)  # type: ignore[attr-defined]


def file_system(path: Path) -> Any:
    """Return the fsspec file system of a path that is not local."""
    return path.fs  # type: ignore[attr-defined]

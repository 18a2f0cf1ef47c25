"""Atomic writes: a file is replaced by a complete new one, or left as it was, whoever else writes it at the same time."""

import errno
import os
import secrets
import stat
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from uavmec_jax.errors import UserError
from uavmec_jax.files.locations import StoreError, file_system, is_local, path_in_store, reason_of, store_errors


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8, atomically."""
    _write(path, lambda file: file.write(text.encode()))


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], *, compressed: bool = True) -> None:
    """Write named arrays as an ``.npz``, atomically."""
    named: dict[str, Any] = dict(arrays)
    save = np.savez_compressed if compressed else np.savez
    _write(path, lambda file: save(file, **named))


_CANNOT_WRITE = {
    *(errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO),
    *(errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ELOOP, errno.ENOENT),
}
"""Numbers of the errors of a file system that refuses to be written to: read-only, not ours, full, damaged, in the way."""


@contextmanager
def writing_to(folder: Path, error: type[UserError]) -> Iterator[None]:
    """Turn what a file system answers that cannot be written to into one line.

    Raises:
        UserError: something in the folder could not be written; of the type ``error``.
    """
    try:
        yield
    except OSError as problem:
        if problem.errno not in _CANNOT_WRITE:  # such as a broken connection
            raise
        inside = str(problem.filename or folder)
        where = (
            inside if inside.startswith(str(folder)) and problem.errno not in (errno.EROFS, errno.ENOSPC) else folder
        )
        raise error(f"{where}: cannot be written to: {reason_of(problem)}") from problem


def create_exclusively(path: Path, content: bytes) -> bool:
    """Create a small file if there is none, and return whether it was created; of several processes, one succeeds.

    Raises:
        OSError: it cannot be written.
    """
    try:
        if is_local(path):
            with path.open("xb") as file:
                file.write(content)
        else:
            with store_errors():
                file_system(path).pipe_file(path_in_store(path), content, mode="create")
    except FileExistsError:
        return False
    except NotImplementedError:  # such as https://
        raise StoreError(errno.EROFS, "cannot be written to", str(path)) from None
    return True


def _write(path: Path, fill: Callable[[IO[bytes]], Any]) -> None:
    with atomic(path) as partial, partial.open("wb") as file:
        fill(file)


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary file of this machine, empty and with the same suffix, for the caller to write.

    On success the temporary file, flushed to the disk, replaces ``path``; a symbolic link there is replaced, not followed.
    After an exception it is removed, and ``path`` is as before. Its name is random and it is created exclusively beside a
    local ``path``, so that several writers do not meet; an object store gets the whole file at once, as one object.

    Raises:
        OSError: it cannot be written, or ``path`` is a folder, a pipe or a device file.
    """
    if is_local(path):
        _check_replaceable(path)
        partial = path.with_name(f".{path.stem[:100]}-{secrets.token_hex(8)}.part{path.suffix}")
        os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))  # and so not through a link
        try:
            yield partial
            _flush_to_disk(partial)
            partial.replace(path)
        except OSError as problem:
            if problem.filename in (None, str(partial)):  # a full disk names no file
                problem.filename = str(path)
            raise
        finally:
            partial.unlink(missing_ok=True)
        _flush_to_disk(path.parent)
        return
    with tempfile.TemporaryDirectory(prefix="uavmec-") as folder:
        partial = Path(folder) / path.name
        yield partial
        with store_errors():
            file_system(path).put_file(str(partial), path_in_store(path))


def _check_replaceable(path: Path) -> None:
    """Check that there is no file, or one that a new one may replace: not ``/dev/null``."""
    try:
        mode = os.lstat(path).st_mode
    except FileNotFoundError:
        return
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):
        raise OSError(errno.EINVAL, "is not a regular file", str(path))


def _flush_to_disk(path: Path) -> None:
    """Wait until a file, or the names in a folder, would survive a loss of power; some file systems know no such thing."""
    is_folder = path.is_dir()
    if is_folder and os.name == "nt":
        return
    descriptor = os.open(path, os.O_RDONLY if is_folder or os.name != "nt" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    except OSError:
        if not is_folder:
            raise
    finally:
        os.close(descriptor)


def set_aside(path: Path) -> None:
    """Rename a damaged file, so that it is not read again; another process may have done so before."""
    with suppress(FileNotFoundError), store_errors():
        path.rename(path.with_suffix(".damaged"))

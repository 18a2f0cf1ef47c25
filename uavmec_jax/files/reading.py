"""Readers of whole files with limits; an error is one line that names the file.

Everything that the package reads from outside comes through this room: no pipe, no device file, nothing that is longer than
its kind may be.
"""

import errno
import hashlib
import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from uavmec_jax.errors import UserError
from uavmec_jax.files.locations import is_local, reason_of, store_errors

MAX_TEXT_BYTES = 16 * 2**20
"""Longest text file: TOML, JSON, a table of devices."""

MAX_TABLE_BYTES = 2**30
"""Longest table of results: a line for every agent of a study."""

_BLOCK = 2**20


def read_text(path: Path, error: type[UserError], encoding: str = "utf-8", *, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Read a text file.

    Raises:
        UserError: the file cannot be read or decoded, is no regular file, or is too long; of the type ``error``.
    """
    try:
        return read_bytes(path, error, max_bytes=max_bytes).decode(encoding).replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as problem:
        where = f"byte {problem.start + 1} is not {problem.encoding.upper()}; save the file as UTF-8"
        raise error(f"{path}: cannot be read: {where}") from None


def read_resource(resource: Any) -> str:
    """Read a text file that ships with the package."""
    text: str = resource.read_text(encoding="utf-8")
    return text


def read_bytes(path: Path, error: type[UserError], *, max_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """Read a file.

    Raises:
        UserError: the file cannot be read, is no regular file, or is longer than ``max_bytes``; of the type ``error``.
    """
    with opened(path, error) as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise error(f"{path}: is longer than {size_in_words(max_bytes)}, the most that such a file may have")
    return content


def digest_of(path: Path, error: type[UserError]) -> str:
    """Return the SHA-256 of a file of any length.

    Raises:
        UserError: the file cannot be read, or is no regular file; of the type ``error``.
    """
    digest = hashlib.sha256()
    with opened(path, error) as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def is_file(path: Path) -> bool:
    """Return whether there is a regular file; no text that cannot be the name of one raises anything."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


@contextmanager
def opened(path: Path, error: type[UserError]) -> Iterator[Any]:
    """Yield a regular file of this machine, or a file in a store, open for reading.

    Raises:
        UserError: the file cannot be read, or is no regular file; of the type ``error``.
    """
    try:
        with store_errors(), open_regular(path) as file:
            yield file
    except FileNotFoundError:  # stores give no reason
        raise error(f"{path}: cannot be read: {os.strerror(errno.ENOENT)}") from None
    except UserError:
        raise
    except (OSError, ValueError) as problem:  # ValueError: a name that no file can have
        reason = reason_of(problem) if isinstance(problem, OSError) else str(problem)
        raise error(f"{path}: cannot be read: {reason}") from None


def open_regular(path: Path) -> Any:
    """Open a regular file for reading; a pipe or a device file, whose reader may wait or read for ever, is refused at once.

    Raises:
        OSError: the file cannot be opened, or is not a regular file.
        ValueError: no file can have such a name.
    """
    if not is_local(path):
        return path.open("rb")
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "is not a regular file", str(path))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_json_or_empty(path: Path) -> dict[str, Any]:
    """Read a small JSON object that another process may be writing; empty if it is missing or damaged."""
    try:
        content = json.loads(read_bytes(path, UserError))
    except (ValueError, RecursionError):  # UserError is a ValueError
        return {}
    return content if isinstance(content, dict) else {}


def size_in_words(n_bytes: int) -> str:
    """Return a number of bytes in the largest unit that leaves it at least 1."""
    for exponent, unit in ((30, "GiB"), (20, "MiB"), (10, "KiB")):
        if n_bytes >= 2**exponent:
            return f"{n_bytes / 2**exponent:g} {unit}"
    return f"{n_bytes} bytes"

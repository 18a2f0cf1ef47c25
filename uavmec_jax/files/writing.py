"""Atomic writes: a file is replaced by a complete new one, or left as it was."""

import errno
import os
import secrets
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from uavmec_jax.files.locations import StoreError, file_system, is_local, path_in_store, store_errors


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8, atomically."""
    _write(path, lambda file: file.write(text.encode()))


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], *, compressed: bool = True) -> None:
    """Write named arrays as an ``.npz``, atomically."""
    named: dict[str, Any] = dict(arrays)
    save = np.savez_compressed if compressed else np.savez
    _write(path, lambda file: save(file, **named))


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
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path of this machine, with the same suffix, for the caller to write.

    On success the temporary file replaces ``path``. After an exception it is removed, and ``path`` is as before. Beside
    a local ``path``; an object store gets the whole file at once, as one object.
    """
    if is_local(path):
        partial = path.with_name(f".{path.stem}-{secrets.token_hex(4)}.part{path.suffix}")
        try:
            yield partial
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
        return
    with tempfile.TemporaryDirectory(prefix="uavmec-") as folder:
        partial = Path(folder) / path.name
        yield partial
        with store_errors():
            file_system(path).put_file(str(partial), path_in_store(path))


def set_aside(path: Path) -> None:
    """Rename a damaged file, so that it is not read again; another process may have done so before."""
    with suppress(FileNotFoundError), store_errors():
        path.rename(path.with_suffix(".damaged"))

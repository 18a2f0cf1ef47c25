"""Atomic writes: a file is replaced by a complete new one, or left as it was."""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8, atomically."""
    _write(path, lambda file: file.write(text.encode()))


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], *, compressed: bool = True) -> None:
    """Write named arrays as an ``.npz``, atomically."""
    named: dict[str, Any] = dict(arrays)
    save = np.savez_compressed if compressed else np.savez
    _write(path, lambda file: save(file, **named))


def _write(path: Path, fill: Callable[[IO[bytes]], Any]) -> None:
    with atomic(path) as partial, partial.open("wb") as file:
        fill(file)
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, with the same suffix, for the caller to write.

    On success the temporary file replaces ``path``. After an exception it is removed, and ``path`` is as before.
    """
    partial = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)

"""Files that are written atomic or not at all, text and TOML, and arrays that are read without pickle."""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np


def write_text(path: Path, text: str) -> None:
    """Write a text file atomic or not at all."""
    _write(path, lambda file: file.write(text.encode()))


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], *, compressed: bool = True) -> None:
    """Write named arrays as an ``.npz``, atomic or not at all."""
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
    """A file to fill that takes the place of ``path`` if all goes well, and is gone if not; it has the same ending."""
    partial = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)

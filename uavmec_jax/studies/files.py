"""Files that are written whole or not at all, and arrays that are read without pickle."""

import os
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from uavmec_jax.errors import StudyError

_DAMAGE = (OSError, ValueError, EOFError, AttributeError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""What zipfile, zlib and NumPy raise on files that are damaged or something else (an unknown compression is
``NotImplementedError``, a bare array where an archive should be ``AttributeError``)."""


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    _write(path, lambda file: file.write(text.encode()))


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays as a compressed ``.npz``, whole or not at all."""
    named: dict[str, Any] = dict(arrays)
    _write(path, lambda file: np.savez_compressed(file, **named))


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read named arrays; each member's CRC is checked.

    Raises:
        StudyError: the file is not there, is no such file, or is damaged.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except _DAMAGE as error:
        raise StudyError(f"{path}: cannot be read: {error}") from None


def _write(path: Path, fill: Callable[[IO[bytes]], Any]) -> None:
    partial = path.with_name(f".{path.name}.part")
    try:
        with partial.open("wb") as file:
            fill(file)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)

"""Named arrays in checked archives: NumPy's ``.npz`` without pickle, with a header, a schema and a SHA-256."""

import hashlib
import json
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from uavmec_jax.errors import StudyError, UserError
from uavmec_jax.files.locations import StoreError, local_copy
from uavmec_jax.files.writing import write_arrays

_READ_ERRORS = (OSError, ValueError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""Errors that zipfile, zlib and NumPy raise for damaged files and for files of another kind."""

_HEADER = "header"
"""Name of the archive's member that holds the header as JSON."""


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read named arrays and check the CRC of each.

    Raises:
        StudyError: the file is missing, damaged or of another kind.
        StoreError: its object store cannot be reached.
    """
    try:
        with _open_archive(path) as archive:
            return {name: archive[name] for name in archive.files}
    except StoreError:
        raise
    except _READ_ERRORS as error:
        raise StudyError(f"{path}: cannot be read: {error}") from None


def write_checked(
    path: Path,
    schema: int,
    metadata: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    *,
    compressed: bool = True,
) -> None:
    """Write named arrays and a header atomically.

    Args:
        path: the file.
        schema: version of the format; :func:`read_checked` refuses other versions.
        metadata: what the header holds besides schema, package version and SHA-256; values that JSON can represent.
        arrays: the arrays by name.
        compressed: whether to compress them.
    """
    header = {"schema": schema, "package": f"uavmec-jax {version('uavmec-jax')}", **metadata}
    header["sha256"] = _digest(header, arrays)
    write_arrays(path, {_HEADER: np.array(json.dumps(header)), **arrays}, compressed=compressed)


def read_checked(
    path: Path, schema: int, kind: str, error: type[UserError]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read and check the header and the arrays that :func:`write_checked` wrote; see :func:`open_checked`."""
    with open_checked(path, schema, kind, error) as (header, arrays):
        return header, dict(arrays)


@contextmanager
def open_checked(
    path: Path, schema: int, kind: str, error: type[UserError]
) -> Iterator[tuple[dict[str, Any], Mapping[str, np.ndarray]]]:
    """Open and check an archive of :func:`write_checked`; yield its header and its arrays, which are read on access.

    The SHA-256 is computed first, one array at a time, since an archive may be larger than the free memory.

    Args:
        path: the file.
        schema: the version of the format that the caller reads.
        kind: what the file should be, for messages, such as ``"a checkpoint"``.
        error: the type of the errors.

    Raises:
        UserError: the file is missing, damaged, altered, of another kind or of another version; of the type ``error``.
        StoreError: its object store cannot be reached, which says nothing about the file.
    """
    try:
        with _open_archive(path) as archive:
            yield _check_header(path, archive, schema, kind, error), _Members(archive)
    except (UserError, StoreError):
        raise
    except _READ_ERRORS as problem:
        raise error(f"{path}: cannot be read: {problem}") from problem


@contextmanager
def _open_archive(path: Path) -> Iterator[Any]:
    """Open an ``.npz`` without pickle."""
    with local_copy(path) as local, local.open("rb") as file:
        archive = np.load(file, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile) or archive.zip is None:
            raise ValueError("it holds a single array")
        if any(member.flag_bits & 1 for member in archive.zip.infolist()):  # zipfile would ask for a password
            raise ValueError("it is encrypted")
        with archive:
            yield archive


class _Members(Mapping[str, np.ndarray]):
    """The arrays of an archive, without its header, each read on access."""

    def __init__(self, archive: Any) -> None:
        self._archive = archive
        self._names = [name for name in archive.files if name != _HEADER]

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._names:
            raise KeyError(name)
        return np.asarray(self._archive[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _check_header(path: Path, archive: Any, schema: int, kind: str, error: type[UserError]) -> dict[str, Any]:
    """Return the header of an archive, without its SHA-256, after checking both against the arrays."""
    try:
        header: dict[str, Any] = json.loads(str(archive[_HEADER]))
        file_schema, digest = header["schema"], header.pop("sha256")
    except (KeyError, ValueError, TypeError):
        raise error(f"{path}: is not {kind}: it has no valid header") from None
    if file_schema != schema:
        raise error(f"{path}: schema is {file_schema!r}; this version reads {schema}")
    if digest != _digest(header, _Members(archive)):
        raise error(f"{path}: was altered: its contents do not fit their SHA-256")
    return header


def _digest(header: Mapping[str, Any], arrays: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a header and of the names, dtypes, shapes and bytes of the arrays."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        leaf = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {leaf.dtype.str} {leaf.shape}".encode())
        digest.update(leaf.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()

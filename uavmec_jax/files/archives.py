"""Named arrays in checked archives: NumPy's ``.npz`` without pickle, with a header, a schema and a SHA-256."""

import errno
import hashlib
import json
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from uavmec_jax.errors import StudyError, UserError
from uavmec_jax.files.locations import StoreError, local_copy, reason_of
from uavmec_jax.files.parsing import parse_json
from uavmec_jax.files.reading import open_regular, size_in_words
from uavmec_jax.files.writing import write_arrays

MAX_ARRAYS = 10_000
"""Most arrays in an archive."""

MAX_USER_BYTES = 2**30
"""Most bytes that the arrays of a file which users exchange (a policy, an evacuation) may take when they are unpacked."""

MAX_BYTES = 2**40
"""Most bytes that the arrays of any archive may take when they are unpacked: checkpoints with their replay buffers."""

_MAX_HEADER = 10_000
"""Longest header of one array, in characters; NumPy's own limit."""

_MAX_DIMENSIONS = 16
_KINDS = "biufU"
"""Kinds of arrays: real numbers, truth values and text. No Python objects, no structures, no complex numbers."""

_READ_ERRORS = (
    *(OSError, ValueError, EOFError, NotImplementedError, RuntimeError, MemoryError, OverflowError, TypeError),
    *(
        SyntaxError,
        KeyError,
        AttributeError,
        IndexError,
        struct.error,
        tokenize.TokenError,
        zipfile.BadZipFile,
        zlib.error,
    ),
)
"""What zipfile, zlib and NumPy raise for damaged files, for files of another kind and for crafted ones."""

_SAYS_NOTHING = (
    *(UnicodeDecodeError, SyntaxError, KeyError, AttributeError, IndexError, TypeError),
    *(struct.error, tokenize.TokenError),
)
"""Those whose text is about Python, not about the file."""

_HEADER = "header"
"""Name of the archive's member that holds the header as JSON."""


def load_arrays(path: Path, *, max_bytes: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """Read named arrays and check the CRC of each.

    Raises:
        StudyError: the file is missing, damaged, of another kind or larger than ``max_bytes`` when unpacked.
        StoreError: its object store cannot be reached.
    """
    with _reported(path, StudyError), _open_archive(path, max_bytes) as archive:
        return dict(archive)


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
    path: Path, schema: int, kind: str, error: type[UserError], *, max_bytes: int = MAX_BYTES
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read and check the header and the arrays that :func:`write_checked` wrote; see :func:`open_checked`."""
    with open_checked(path, schema, kind, error, max_bytes=max_bytes) as (header, arrays):
        return header, dict(arrays)


@contextmanager
def open_checked(
    path: Path, schema: int, kind: str, error: type[UserError], *, max_bytes: int = MAX_BYTES
) -> Iterator[tuple[dict[str, Any], Mapping[str, np.ndarray]]]:
    """Open and check an archive of :func:`write_checked`; yield its header and its arrays, which are read on access.

    The SHA-256 is computed first, one array at a time, since an archive may be larger than the free memory.

    Args:
        path: the file.
        schema: the version of the format that the caller reads.
        kind: what the file should be, for messages, such as ``"a checkpoint"``.
        error: the type of the errors.
        max_bytes: most bytes that the arrays may take when they are unpacked.

    Raises:
        UserError: the file is missing, damaged, altered, of another kind or version, or too large; of the type ``error``.
        StoreError: its object store cannot be reached, which says nothing about the file.
    """
    with _reported(path, error) as report, _open_archive(path, max_bytes) as archive:
        header = _check_header(path, archive, schema, kind, error)
        report.clear()  # what the caller raises is not the file's fault
        yield header, _WithoutHeader(archive, path, error)


@contextmanager
def _reported(path: Path, error: type[UserError]) -> Iterator[list[type[Exception]]]:
    """Turn what goes wrong with an archive inside into one line; yield the types of errors, which the caller may clear."""
    expected: list[type[Exception]] = list(_READ_ERRORS)
    try:
        yield expected
    except (UserError, StoreError):
        raise
    except Exception as problem:
        if not isinstance(problem, tuple(expected)):
            raise
        # an offset in front of the file's beginning is damage; other errors of the system say nothing about the file
        damage = isinstance(problem, OSError) and problem.errno == errno.EINVAL
        raise error(f"{path}: cannot be read: {_reason(problem)}") from (None if damage else problem)


def _reason(problem: Exception) -> str:
    """Return what went wrong in words."""
    if isinstance(problem, OSError):
        return reason_of(problem)
    if isinstance(problem, _SAYS_NOTHING):
        return f"it is damaged ({type(problem).__name__})"
    return str(problem) or type(problem).__name__


@contextmanager
def _open_archive(path: Path, max_bytes: int) -> Iterator["_Archive"]:
    with local_copy(path) as local, open_regular(local) as file:
        if file.read(6) == npy.MAGIC_PREFIX:
            raise ValueError("it holds a single array")
        file.seek(0)
        with zipfile.ZipFile(file) as archive:
            yield _Archive(archive, max_bytes)


class _Archive(Mapping[str, np.ndarray]):
    """The arrays of an ``.npz``, each read on access, after all sizes were checked."""

    def __init__(self, archive: zipfile.ZipFile, max_bytes: int) -> None:
        members = archive.infolist()
        if len(members) > MAX_ARRAYS:
            raise ValueError(f"it holds {len(members)} arrays; at most {MAX_ARRAYS} are read")
        for member in members:
            if member.flag_bits & 1:  # zipfile would ask for a password
                raise ValueError("it is encrypted")
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError("it is compressed in another way than NumPy compresses")
        if (unpacked := sum(member.file_size for member in members)) > max_bytes:
            raise ValueError(f"it takes {unpacked} bytes unpacked; at most {size_in_words(max_bytes)} are read")
        self._archive = archive
        self._members = {member.filename.removesuffix(".npy"): member for member in members}
        if len(self._members) < len(members):
            raise ValueError("it holds two arrays of the same name")

    def __getitem__(self, name: str) -> np.ndarray:
        member = self._members[name]
        with self._archive.open(member) as file:
            _check_array_header(name, file, member.file_size)
        with self._archive.open(member) as file:
            array = npy.read_array(file, allow_pickle=False, max_header_size=_MAX_HEADER)
            file.read(1)  # zipfile checks the CRC at the end
        return np.asarray(array)

    def __iter__(self) -> Iterator[str]:
        return iter(self._members)

    def __len__(self) -> int:
        return len(self._members)


def _check_array_header(name: str, file: Any, file_size: int) -> None:
    """Check that an array is of a kind that is read, and that it takes as many bytes as its member holds."""
    major = npy.read_magic(file)[0]
    read_header = {1: npy.read_array_header_1_0, 2: npy.read_array_header_2_0}.get(major)
    if read_header is None:
        raise ValueError(f"the header of array {name!r} is of version {major}; 1 and 2 are read")
    shape, _, dtype = read_header(file, max_header_size=_MAX_HEADER)
    if dtype.hasobject or dtype.kind not in _KINDS or dtype.names is not None:
        raise ValueError(f"array {name!r} is of type {dtype}; numbers, truth values and text are read")
    if len(shape) > _MAX_DIMENSIONS or any(length < 0 for length in shape):
        raise ValueError(f"array {name!r} has the shape {shape}")
    if math.prod(shape) * dtype.itemsize != file_size - file.tell():
        raise ValueError(f"array {name!r} is not as long as its header says")


class _WithoutHeader(Mapping[str, np.ndarray]):
    """The arrays of an archive, without its header; an array that cannot be read is reported like a damaged file."""

    def __init__(self, archive: _Archive, path: Path, error: type[UserError]) -> None:
        self._archive, self._path, self._error = archive, path, error
        self._names = [name for name in archive if name != _HEADER]

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._names:
            raise KeyError(name)
        with _reported(self._path, self._error):
            return self._archive[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _check_header(path: Path, archive: _Archive, schema: int, kind: str, error: type[UserError]) -> dict[str, Any]:
    """Return the header of an archive, without its SHA-256, after checking both against the arrays."""
    if _HEADER not in archive:
        raise error(f"{path}: is not {kind}: it has no valid header")
    text = archive[_HEADER]
    if text.shape != () or text.dtype.kind != "U":
        raise error(f"{path}: is not {kind}: it has no valid header")
    try:
        header = parse_json(str(text), path, error)
    except UserError:
        raise error(f"{path}: is not {kind}: it has no valid header") from None
    if not isinstance(header, dict) or not {"schema", "sha256"} <= set(header):
        raise error(f"{path}: is not {kind}: it has no valid header")
    file_schema, digest = header["schema"], header.pop("sha256")
    if file_schema != schema or isinstance(file_schema, bool):
        raise error(f"{path}: schema is {file_schema!r}; this version reads {schema}")
    if digest != _digest(header, _WithoutHeader(archive, path, error)):
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

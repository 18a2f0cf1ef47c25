"""Named arrays in checked archives: read without pickle, with a schema and a SHA-256."""

import hashlib
import json
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from uavmec_jax.errors import StudyError, UserError
from uavmec_jax.files.writing import write_arrays

_DAMAGE = (OSError, ValueError, EOFError, AttributeError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""What zipfile, zlib and NumPy raise on files that are damaged or something else (an unknown compression is
``NotImplementedError``, a bare array where an archive should be ``AttributeError``)."""


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


_HEADER = "header"


def write_checked(
    path: Path,
    schema: int,
    facts: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    *,
    compressed: bool = True,
) -> None:
    """Write named arrays under a header of facts (what JSON can hold), schema and SHA-256, atomic or not at all."""
    header = {"schema": schema, "package": f"uavmec-jax {metadata.version('uavmec-jax')}", **facts}
    header["sha256"] = _digest(header, arrays)
    write_arrays(path, {_HEADER: np.array(json.dumps(header)), **arrays}, compressed=compressed)


def read_checked(
    path: Path, schema: int, what: str, error: type[UserError]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The facts and the arrays that :func:`write_checked` wrote; see :func:`open_checked`."""
    with open_checked(path, schema, what, error) as (facts, arrays):
        return facts, dict(arrays)


@contextmanager
def open_checked(
    path: Path, schema: int, what: str, error: type[UserError]
) -> Iterator[tuple[dict[str, Any], Mapping[str, np.ndarray]]]:
    """The facts that :func:`write_checked` wrote, and its arrays, each read when it is asked for.

    All of them are checked first, one at a time: an archive may be larger than the memory that is free.

    Args:
        path: the file.
        schema: the version that is read.
        what: the file should be, for messages.
        error: what is raised.

    Raises:
        UserError: the file is not there, is damaged, was altered, is something else or of another version.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            facts = _checked_facts(path, archive, schema, what, error)
            yield facts, _Members(archive)
    except UserError:
        raise
    except _DAMAGE as damage:
        raise error(f"{path}: cannot be read: {damage}") from None


class _Members(Mapping[str, np.ndarray]):
    """The arrays of an archive, without its header."""

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


def _checked_facts(path: Path, archive: Any, schema: int, what: str, error: type[UserError]) -> dict[str, Any]:
    try:
        facts: dict[str, Any] = json.loads(str(archive[_HEADER]))
        found, digest = facts["schema"], facts.pop("sha256")
    except (KeyError, ValueError, TypeError):
        raise error(f"{path}: is not {what}, or one from before they had a header") from None
    if found != schema:
        raise error(f"{path}: schema is {found!r}; this version reads {schema}")
    if digest != _digest(facts, _Members(archive)):
        raise error(f"{path}: was altered: its contents do not fit their SHA-256")
    return facts


def _digest(facts: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for name in sorted(arrays):
        leaf = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {leaf.dtype.str} {leaf.shape}".encode())
        digest.update(leaf.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()

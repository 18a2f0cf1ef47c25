"""Mutations of `.npz` files: damage, crafted zip members, and arrays or headers that are changed and sealed again."""

import copy
import io
import json
import struct
import zipfile
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from fuzz_mutations import NUMBERS, WORDS, damage, edit

from uavmec_jax.files.archives import write_checked

_HEADER = "header"
_TYPES = ("f8", "f4", "f2", ">f4", "i8", "i4", "u1", "?", "c8", "c16", "U3", "S3", "M8[s]", "g", "i4,f4")
_BOMB_BYTES = 100 * 2**20


def mutate_archive(scratch: Path) -> Any:
    """Return a mutation of archives; those that are sealed are written to ``scratch`` first."""

    def mutate(rng: Random, seeds: list[bytes]) -> bytes:
        content, kind = rng.choice(seeds), rng.random()
        if kind < 0.25:
            return damage(rng, content, seeds)
        if kind < 0.45:
            return _crafted(rng, content)
        header, arrays = _unpack(content)
        header, arrays = copy.deepcopy(header), dict(arrays)
        for _ in range(rng.choice((1, 1, 2, 3))):
            if header is not None and rng.random() < 0.5:
                header = edit(rng, header, 1)
            elif arrays:
                _change_arrays(rng, arrays)
        try:
            return _pack(header, arrays, scratch)
        except (ValueError, TypeError, OverflowError, KeyError, AttributeError):  # NumPy or JSON cannot write it
            return damage(rng, content, seeds)

    return mutate


@cache
def _unpack(content: bytes) -> tuple[Any, dict[str, np.ndarray]]:
    """Return the header, ``None`` where there is none, and the arrays."""
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    text = arrays.pop(_HEADER, None)
    header = None if text is None else json.loads(str(text))
    if header is not None:
        del header["sha256"]
    return header, arrays


def _pack(header: Any, arrays: dict[str, np.ndarray], scratch: Path) -> bytes:
    """Return an archive with a right SHA-256, or one without a header."""
    if header is None:
        file = io.BytesIO()
        np.savez(file, **arrays)  # type: ignore[arg-type]
        return file.getvalue()
    facts = dict(header) if isinstance(header, dict) else {"a": header}
    write_checked(scratch, facts.get("schema", 1), facts, arrays, compressed=False)
    return scratch.read_bytes()


def _change_arrays(rng: Random, arrays: dict[str, np.ndarray]) -> None:
    name, what = rng.choice(list(arrays)), rng.randrange(12)
    array, other = arrays[name], arrays[rng.choice(list(arrays))]
    if what < 4 and array.size:
        arrays[name] = _with_values(rng, array)
    elif what == 4:
        kind = rng.choice(_TYPES)
        arrays[name] = np.zeros(array.shape, kind) if "," in kind or "M8" in kind else _cast(array, kind)
    elif what == 5:
        shapes = (array.reshape(-1), array[None], array[..., None], array.T, np.zeros((0,), array.dtype), array[:0])
        arrays[name] = rng.choice(shapes) if array.ndim else array[None]
    elif what == 6 and array.ndim:
        cut = (array[:1], array[:-1], array[::-1], array[..., :-1], np.concatenate([array, array]), array[:0])
        arrays[name] = rng.choice(cut)
    elif what == 7:
        del arrays[name]
    elif what == 8:
        arrays[
            rng.choice((f"{name}_", "x", "a/b", "../x", *(word for word in WORDS if word.isprintable() and word)))
        ] = array
    elif what == 9:
        arrays[rng.choice((f"{name}/x", name.rpartition("/")[0] or "x", name.upper()))] = arrays.pop(name)
    else:
        arrays[name] = other


def _cast(array: np.ndarray, kind: str) -> np.ndarray:
    with np.errstate(all="ignore"):
        return array.astype(kind) if array.dtype.kind in "biuf" else np.zeros(array.shape, kind)


def _with_values(rng: Random, array: np.ndarray) -> np.ndarray:
    """Return a copy with a hostile number in one place, in one row or everywhere."""
    array, number = array.copy(), rng.choice([float(number) for number in NUMBERS[:25]])
    if array.dtype.kind not in "biuf":
        return np.full(array.shape, rng.choice(WORDS))
    with np.errstate(all="ignore"):
        hostile = np.array(number).astype(array.dtype)
    if rng.random() < 0.6 or not array.ndim:
        array.reshape(-1)[rng.randrange(array.size)] = hostile
    elif rng.random() < 0.5:
        array[rng.randrange(len(array))] = hostile
    else:
        array[...] = hostile
    return array


def _member(name: str, array: np.ndarray) -> tuple[str, bytes]:
    file = io.BytesIO()
    np.lib.format.write_array(file, array, allow_pickle=True)
    return f"{name}.npy", file.getvalue()


def _zip(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content, compress_type=method)
    return file.getvalue()


def _npy(header: str, body: bytes = b"", major: int = 1) -> bytes:
    """Return the contents of an ``.npy`` file with a header that is not checked."""
    text = header.encode("latin-1", "replace") + b"\n"
    length = struct.pack("<H", len(text) & 0xFFFF) if major == 1 else struct.pack("<I", len(text))
    return b"\x93NUMPY" + bytes([major, 0]) + length + text + body


@cache
def _bomb() -> bytes:
    """Return a member of a hundred million zeros in a hundred kilobytes."""
    return _zip(
        [
            (
                "bomb.npy",
                _npy(f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({_BOMB_BYTES},)}}", bytes(_BOMB_BYTES)),
            )
        ],
        zipfile.ZIP_DEFLATED,
    )


_CRAFTED_HEADERS = (
    "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (-1,)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3.5)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': " + "(" * 3000,
    "{'descr': '<f4', 'fortran_order': False, 'shape': (" + "1," * 40 + ")}",
    "{'descr': '|O', 'fortran_order': False, 'shape': (1,)}",
    "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,)}",
    "{'descr': '<f0', 'fortran_order': False, 'shape': (1,)}",
    "{'descr': '<V9999999999', 'fortran_order': False, 'shape': (1,)}",
    "{'descr': '<f4', 'fortran_order': 7, 'shape': ()}",
    "{'descr': '<f4'}",
    "[1, 2]",
    "__import__('os')",
    "{" * 200,
    " " * 20_000,
    "",
)


def _crafted(rng: Random, content: bytes) -> bytes:
    """Return an archive that zipfile or NumPy reads in an unexpected way."""
    header, arrays = _unpack(content)
    text = np.array(json.dumps({**(header or {}), "sha256": "0" * 64}))
    members = [_member(_HEADER, text)] * (header is not None) + [_member(name, array) for name, array in arrays.items()]
    at, what = rng.randrange(len(members)), rng.randrange(12)
    name = members[at][0]
    if what < 4:
        members[at] = (
            name,
            _npy(rng.choice(_CRAFTED_HEADERS), bytes(rng.choice((0, 4, 64))), rng.choice((1, 1, 2, 3, 9))),
        )
    elif what == 4:
        return _zip(members, rng.choice((zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2, zipfile.ZIP_DEFLATED)))
    elif what == 5:
        return damage(rng, _zip(members, rng.choice((zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2))), [content])
    elif what == 6:
        return _with_zip_fields(rng, _zip(members))
    elif what == 7:
        members.append((rng.choice((name, "../x.npy", "/x.npy", "a" * 60_000, "", "x.npy/", "é.npy")), members[at][1]))
    elif what == 8:
        members[at] = (
            name,
            rng.choice((b"", b"x", pickled := _member("x", np.array([{1: 2}], object))[1], pickled[:40])),
        )
    elif what == 9:
        return rng.choice((members[at][1], _zip([]), content + bytes(1000), bytes(1000) + content, content[:-22] * 2))
    elif what == 10 and rng.random() < 0.1:
        return rng.choice((_bomb(), _zip([(f"{number}.npy", b"") for number in range(10_001)])))
    else:
        rng.shuffle(members)
        del members[at]
    return _zip(members)


def _with_zip_fields(rng: Random, content: bytes) -> bytes:
    """Return a zip with another flag, method, size, CRC or offset in its table of contents."""
    data = bytearray(content)
    starts = [at for at in range(len(data) - 46) if data[at : at + 4] == b"PK\x01\x02"]
    at = rng.choice(starts)
    offset, size = rng.choice(((8, 2), (10, 2), (16, 4), (20, 4), (24, 4), (28, 2), (30, 2), (42, 4), (6, 2)))
    data[at + offset : at + offset + size] = rng.choice((0, 1, 8, 9, 12, 14, 99, 2**16 - 1)).to_bytes(size, "little")
    if offset == 8 and rng.random() < 0.5:  # also where the member begins
        first = data.find(b"PK\x03\x04")
        data[first + 6 : first + 8] = (1).to_bytes(2, "little")
    return bytes(data)

"""Checked archives: what was written comes back, and any damage or alteration is refused in one line."""

import json
import zipfile

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from uavmec_jax.errors import StudyError, TrafficError
from uavmec_jax.files import archives
from uavmec_jax.files.archives import load_arrays, open_checked, read_checked, write_checked

ARRAYS = {
    "weights": np.linspace(0, 1, 500, dtype=np.float32).reshape(5, 100),
    "count": np.array(7),
    "names": np.array(["a", "b"]),
    "mask": np.array([True, False]),
    "nothing": np.zeros((0, 3)),
}


@pytest.fixture(params=[True, False], ids=["compressed", "stored"])
def path(tmp_path, request):
    path = tmp_path / "x.npz"
    write_checked(path, 3, {"agents": [1, 2], "name": "é"}, ARRAYS, compressed=request.param)
    return path


def read(path, schema=3):
    return read_checked(path, schema, "a checkpoint", TrafficError)


def rewrite(path, header=None, **changes):
    """Change an archive as a person with an editor would, without a new SHA-256."""
    arrays = load_arrays(path)
    fields = json.loads(str(arrays.pop("header"))) | (header or {})
    np.savez(path, header=np.array(json.dumps(fields)), **(arrays | changes))


def test_header_and_arrays_come_back(path):
    header, arrays = read(path)
    assert header["agents"] == [1, 2]
    assert header["name"] == "é"
    assert header["schema"] == 3
    assert header["package"].startswith("uavmec-jax ")
    assert "sha256" not in header
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert_array_equal(arrays[name], array, strict=True)


def test_arrays_are_read_on_access(path):
    with open_checked(path, 3, "a checkpoint", TrafficError) as (_, arrays):
        assert list(arrays) == list(ARRAYS)
        assert len(arrays) == len(ARRAYS)
        assert_array_equal(arrays["weights"], ARRAYS["weights"])
        with pytest.raises(KeyError):
            arrays["header"]


def test_errors_of_the_caller_pass(path):
    with pytest.raises(KeyError, match="mine"), open_checked(path, 3, "a checkpoint", TrafficError):
        raise KeyError("mine")


def test_a_flipped_bit_is_refused_or_without_effect(path):
    content = path.read_bytes()
    refused = 0
    for position in range(0, len(content), 31):
        flipped = bytearray(content)
        flipped[position] ^= 0x10
        path.write_bytes(bytes(flipped))
        try:
            header, arrays = read(path)
        except TrafficError:
            refused += 1
            continue
        assert header["agents"] == [1, 2]  # the bit was in a field of the zip file that no array depends on
        for name, array in ARRAYS.items():
            assert_array_equal(arrays[name], array)
    assert refused > len(content) // 31 // 2


def test_an_archive_that_claims_to_be_encrypted_is_refused(path):
    content = bytearray(path.read_bytes())
    content[content.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(content)
    with pytest.raises(TrafficError, match=r"x\.npz: cannot be read: it is encrypted"):
        read(path)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.9, 0.999])
def test_a_truncated_archive_is_refused(path, share):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(TrafficError, match=r"x\.npz: cannot be read"):
        read(path)
    with pytest.raises(StudyError, match=r"x\.npz: cannot be read"):
        load_arrays(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"header": {"name": "e"}},
        {"header": {"agents": [2, 1]}},
        {"header": {"more": 1}},
        {"header": {"sha256": "0" * 64}},
        {"weights": ARRAYS["weights"] * 2},
        {"weights": ARRAYS["weights"].astype(np.float64)},
        {"weights": ARRAYS["weights"].reshape(100, 5)},
        {"extra": np.zeros(1)},
    ],
    ids=["value", "order", "key", "digest", "array", "dtype", "shape", "member"],
)
def test_an_altered_archive_is_refused(path, changes):
    rewrite(path)
    read(path)  # rewriting alone changes nothing
    rewrite(path, **changes)
    with pytest.raises(TrafficError, match=r"x\.npz: was altered: its contents do not fit their SHA-256"):
        read(path)


def test_another_schema_is_refused(path):
    with pytest.raises(TrafficError, match=r"x\.npz: schema is 3; this version reads 4"):
        read(path, schema=4)
    rewrite(path, {"schema": "three"})
    with pytest.raises(TrafficError, match=r"x\.npz: schema is 'three'; this version reads 3"):
        read(path)


@pytest.mark.parametrize(
    "header", [None, "{", "[1]", "3", "{}", '{"schema": 3}', '{"sha256": "0"}'],
    ids=["none", "no JSON", "list", "number", "empty", "no digest", "no schema"],
)  # fmt: skip
def test_an_archive_without_a_valid_header_is_refused(tmp_path, header):
    path = tmp_path / "x.npz"
    np.savez(path, weights=np.zeros(3), **({} if header is None else {"header": np.array(header)}))
    with pytest.raises(TrafficError, match=r"x\.npz: is not a checkpoint: it has no valid header"):
        read(path)


@pytest.mark.parametrize("kind", ["text", "empty", "bare array", "pickle", "zip", "folder", "missing"])
def test_a_file_of_another_kind_is_refused(tmp_path, kind):
    path = tmp_path / "x.npz"
    if kind == "bare array":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    elif kind == "pickle":
        np.savez(path, header=np.array({"schema": 3}, dtype=object))
    elif kind == "zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("header.npy", "not an array")
    elif kind == "folder":
        path.mkdir()
    elif kind != "missing":
        path.write_text("<osm/>" if kind == "text" else "")
    with pytest.raises(TrafficError, match=r"x\.npz: (cannot be read|is not a checkpoint)") as error:
        read(path)
    assert "\n" not in str(error.value)


def test_the_header_is_part_of_the_digest():
    digest = archives._digest({"a": 1, "b": 2}, ARRAYS)
    assert digest == archives._digest({"b": 2, "a": 1}, dict(reversed(ARRAYS.items())))
    assert digest != archives._digest({"a": 1, "b": 3}, ARRAYS)

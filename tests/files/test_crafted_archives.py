"""Archives made by hand to do harm: refused in one line, before anything large is read."""

import io
import json
import os
import struct
import zipfile

import numpy as np
import pytest

from uavmec_jax.errors import StudyError
from uavmec_jax.files import archives
from uavmec_jax.files.archives import load_arrays, open_checked, read_checked, write_checked


def npy_bytes(array=None, header=None, body=b""):
    """Return an array as NumPy writes it, or a body with a header of one's own."""
    if header is None:
        file = io.BytesIO()
        np.save(file, array)
        return file.getvalue()
    text = header.encode("latin-1") + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


def zipped(path, content, *, method=zipfile.ZIP_DEFLATED, names=("a.npy",)):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name in names:
            archive.writestr(name, content)
    return path


def refused(path, message):
    with pytest.raises(StudyError, match=message) as error:
        load_arrays(path)
    assert len(str(error.value)) <= 400
    with pytest.raises(StudyError):
        read_checked(path, 1, "a test", StudyError)


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2], ids=["lzma", "bzip2"])
@pytest.mark.parametrize("damaged", [False, True])
def test_members_compressed_in_another_way_are_refused(tmp_path, method, damaged):
    path = zipped(tmp_path / "x.npz", npy_bytes(np.arange(100)), method=method)
    if damaged:
        content = bytearray(path.read_bytes())
        content[60:70] = b"\xff" * 10
        path.write_bytes(content)
    refused(path, r"x\.npz: cannot be read: it is compressed in another way than NumPy compresses$")


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-3,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (2,)}",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,)}",
        "{'descr': '<c16', 'fortran_order': False, 'shape': (0,)}",
        "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "0," * 40 + ")}",
        "{'descr': '<f8', 'shape': (1,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (",
        "[" * 5000,
        "{'descr': 'x9', 'fortran_order': 0, 'shape': 'a'}",
        "3",
        "\x00" * 20,
        "__import__('os').system('touch planted')",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1,)}" + " " * 20_000,
    ],
)
def test_an_array_with_a_malformed_or_huge_header_is_refused(tmp_path, monkeypatch, header):
    monkeypatch.chdir(tmp_path)
    refused(zipped(tmp_path / "x.npz", npy_bytes(header=header, body=b"\0" * 8)), r"x\.npz: cannot be read: ")
    assert os.listdir(tmp_path) == ["x.npz"]


def test_another_version_of_the_array_format_is_refused(tmp_path):
    content = bytearray(npy_bytes(np.zeros(3)))
    content[6] = 9
    refused(zipped(tmp_path / "x.npz", bytes(content)), r"the header of array 'a' is of version 9; 1 and 2 are read$")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_arrays_of_one_name_are_refused(tmp_path):
    path = zipped(tmp_path / "x.npz", npy_bytes(np.zeros(3)), names=("a.npy", "a.npy"))
    refused(path, r"x\.npz: cannot be read: it holds two arrays of the same name$")


def test_too_many_arrays_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(archives, "MAX_ARRAYS", 10)
    path = zipped(tmp_path / "x.npz", npy_bytes(np.zeros(1)), names=[f"a{k}.npy" for k in range(11)])
    refused(path, r"it holds 11 arrays; at most 10 are read$")


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path):
    path = zipped(tmp_path / "x.npz", npy_bytes(np.zeros(30_000_000)))
    assert path.stat().st_size < 300_000
    with pytest.raises(StudyError, match=r"it takes 240000128 bytes unpacked; at most 100 MiB are read$"):
        load_arrays(path, max_bytes=100 * 2**20)


def test_a_member_that_lies_about_its_length_is_refused(tmp_path):
    path = zipped(tmp_path / "x.npz", npy_bytes(np.zeros(1000)), method=zipfile.ZIP_STORED)
    content = bytearray(path.read_bytes())
    central = content.index(b"PK\x01\x02")
    content[central + 20 : central + 28] = struct.pack("<II", 2**31, 2**31)
    path.write_bytes(content)
    refused(path, r"x\.npz: cannot be read: ")


@pytest.mark.parametrize("header", ["[" * 200_000, '{"schema": ' + "9" * 5000 + "}", '{"schema": 1, "schema": 1}'])
def test_a_header_that_no_parser_takes_is_refused(tmp_path, header):
    path = tmp_path / "x.npz"
    np.savez(path, header=np.array(header))
    with pytest.raises(StudyError, match=r"x\.npz: is not a test: it has no valid header$"):
        read_checked(path, 1, "a test", StudyError)


@pytest.mark.parametrize("header", [np.arange(3), np.array(["{}", "{}"]), np.array(b"{}"), np.array(1.5)])
def test_a_header_of_another_type_is_refused(tmp_path, header):
    path = tmp_path / "x.npz"
    np.savez(path, header=header)
    with pytest.raises(StudyError, match=r"x\.npz: (is not a test|cannot be read)"):
        read_checked(path, 1, "a test", StudyError)


def test_a_schema_that_is_true_is_not_schema_1(tmp_path):
    path = tmp_path / "x.npz"
    write_checked(path, 1, {}, {"a": np.zeros(1)})
    arrays = load_arrays(path)
    header = json.loads(str(arrays.pop("header"))) | {"schema": True}
    header.pop("sha256")
    header["sha256"] = archives._digest(header, arrays)
    np.savez(path, header=np.array(json.dumps(header)), **arrays)
    with pytest.raises(StudyError, match=r"schema is True; this version reads 1$"):
        read_checked(path, 1, "a test", StudyError)


def test_an_array_that_is_damaged_after_the_check_is_reported_with_the_file(tmp_path):
    path = tmp_path / "x.npz"
    write_checked(path, 1, {}, {"a": np.arange(10_000)}, compressed=False)
    with open_checked(path, 1, "a test", StudyError) as (_, arrays):
        with path.open("r+b") as file:
            file.seek(path.stat().st_size // 2)
            file.write(b"\xff" * 100)
        with pytest.raises(StudyError, match=r"x\.npz: cannot be read: Bad CRC-32"):
            arrays["a"]


def test_a_fifo_is_no_archive(tmp_path):
    os.mkfifo(tmp_path / "x.npz")
    refused(tmp_path / "x.npz", r"x\.npz: cannot be read: is not a regular file$")

"""XML from outside: no entities, no bombs, no surprises of the parser."""

import bz2
import gzip
import os
import time

import pytest

from uavmec_jax.errors import TrafficError
from uavmec_jax.files.xml import CheckingHandler, copy_xml

NODE = b'<node id="1" lat="42.65" lon="-73.75"/>\n'


@pytest.fixture
def refused(tmp_path):
    """Write bytes, and check that they are refused with a message."""

    def check(content, message):
        path = tmp_path / "x.xml"
        path.write_bytes(content)
        with pytest.raises(TrafficError, match=message) as error:
            copy_xml(path, tmp_path / "copy.xml", CheckingHandler(), TrafficError)
        assert len(str(error.value)) <= 400
        return tmp_path / "copy.xml"

    return check


def test_a_file_is_copied(tmp_path):
    for content in (b"<osm>\n<node/></osm>", gzip.compress(b"<osm/>"), bz2.compress(b"<osm/>")):
        (tmp_path / "x.xml").write_bytes(content)
        copy_xml(tmp_path / "x.xml", tmp_path / "copy.xml", CheckingHandler(), TrafficError)
        assert (tmp_path / "copy.xml").read_bytes().startswith(b"<osm")


@pytest.mark.parametrize("compress", [gzip.compress, bz2.compress])
def test_a_bomb_of_valid_elements_is_refused_soon(refused, compress):
    bomb = compress(b"<osm>") + compress(NODE * 20_000) * 50  # the parts of a compressed file follow each other
    start = time.monotonic()
    copy = refused(bomb, r"x\.xml: expands to more than 60 times its length; give it without compression$")
    assert time.monotonic() - start < 2
    assert copy.stat().st_size == 0


def test_a_bomb_of_five_megabytes_is_refused_in_two_seconds(refused):
    bomb = gzip.compress(b"<osm>" + NODE * 500_000) + gzip.compress(b" " * 50_000_000) * (5 * 2**20 // 48_000)
    assert len(bomb) > 5 * 2**20
    start = time.monotonic()
    copy = refused(bomb, "expands to more than 60 times its length")
    assert time.monotonic() - start < 2
    assert copy.stat().st_size == 0


def test_elements_nested_too_deep_are_refused(refused):
    refused(b"<osm>" + b"<way>" * 100_000, r"x\.xml: nests elements more than 40 deep$")


@pytest.mark.parametrize("encoding", ["klingon", "x" * 5000, "zip", "rot13", "utf-7", "idna", "undefined", "hex"])
def test_an_encoding_that_is_not_known_is_refused(refused, encoding):
    refused(f'<?xml version="1.0" encoding="{encoding}"?><osm/>'.encode(), r"x\.xml: is (not XML|in an encoding)")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\0" * 100,
        b"<osm",
        b"<osm></way>",
        b"<osm/>x",
        b"\x1f\x8b",
        b"BZh9",
        gzip.compress(NODE, mtime=0)[:-9],
        b"\xff\xfe<",
    ],
)
def test_what_is_not_xml_is_refused(refused, content):
    refused(content, r"x\.xml: (is not XML|is truncated|cannot be read)")


@pytest.mark.parametrize(
    "document",
    [
        b'<!DOCTYPE a [<!ENTITY b "c">]><osm/>',
        b'<!DOCTYPE osm SYSTEM "file:///etc/passwd"><osm/>',
        b'<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><osm>&b;</osm>',
    ],
)
def test_a_dtd_is_refused(refused, document):
    refused(document, r"x\.xml: declares a DTD or entities, which are refused")


def test_a_fifo_is_no_xml(tmp_path):
    os.mkfifo(tmp_path / "x.xml")
    with pytest.raises(TrafficError, match=r"x\.xml: cannot be read: is not a regular file$"):
        copy_xml(tmp_path / "x.xml", tmp_path / "copy.xml", CheckingHandler(), TrafficError)

"""Files from outside: bad ones are refused, good ones are copied completely."""

import bz2
import gzip
import zipfile

import pytest

from tests.traffic.networks import osm_extract
from uavmec_jax.errors import TrafficError
from uavmec_jax.files import xml
from uavmec_jax.traffic.checked_xml import checked_copy

BOMB = """<?xml version="1.0"?><!DOCTYPE osm [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]><osm><note>&b;</note></osm>"""
EXTERNAL = (
    """<?xml version="1.0"?><!DOCTYPE osm [<!ENTITY x SYSTEM "file:///etc/passwd">]><osm><note>&x;</note></osm>"""
)
NET = '<net><junction id="j"/><edge id="e"><lane id="e_0" speed="13.9" length="50.0"/></edge></net>'


@pytest.mark.parametrize("pack", [bytes, gzip.compress, bz2.compress], ids=["plain", "gzip", "bzip2"])
def test_an_extract_is_copied_decompressed_and_measured(tmp_path, pack):
    text = osm_extract(2, 3).encode()
    (tmp_path / "extract").write_bytes(pack(text))
    contents = checked_copy(tmp_path / "extract", tmp_path / "copy.xml", "osm")
    assert (tmp_path / "copy.xml").read_bytes() == text
    assert contents.counts["node"] == 12
    assert contents.counts["way"] == 2 + 3 + 4
    assert (contents.west, contents.south) == (9.7, 49.99)
    assert contents.overlaps((9.0, 49.0, 9.71, 50.0))
    assert not contents.overlaps((10.0, 49.0, 10.1, 51.0))


@pytest.mark.parametrize(
    ("kind", "text", "line"),
    [
        ("osm", "no XML at all", "is not XML, or is truncated (line 1"),
        ("osm", "", "is not XML, or is truncated"),
        ("osm", osm_extract()[:-40], "is not XML, or is truncated"),
        ("osm", BOMB, "declares a DTD or entities, which are refused"),
        ("osm", EXTERNAL, "declares a DTD or entities, which are refused"),
        ("osm", NET, "begins with <net>; an OpenStreetMap extract begins with <osm>"),
        (
            "osm",
            "<osm><include href='x'/></osm>",
            "holds <include>, which is not an element of an OpenStreetMap extract",
        ),
        ("osm", "<osm><node id='7' lat='x' lon='1'/></osm>", "node 7 has no lon and lat in degrees"),
        (
            "osm",
            "<osm><node id='7' lat='95' lon='1'/></osm>",
            "node 7 lies at lon 1.0, lat 95.0, which is not on the Earth",
        ),
        ("net", "<configuration/>", "is a SUMO configuration, which is never run; give a SUMO network"),
        ("net", "<sumoConfiguration/>", "is a SUMO configuration, which is never run"),
        ("net", NET.replace("13.9", "-13.9"), "speed of lane 'e_0' is '-13.9'; it should be a number above 0"),
        ("net", NET.replace("13.9", "nan"), "speed of lane 'e_0' is 'nan'"),
        ("net", NET.replace("50.0", "long"), "length of lane 'e_0' is 'long'"),
        ("net", NET.replace("<junction", "<include href='/etc/passwd'/><junction"), "holds <include>, which is not an"),
        ("edges", "<edges><edge id='a' speed='0'/></edges>", "speed of edge 'a' is '0'; it should be a number above 0"),
        ("types", "<types><type id='a' numLanes='-2'/></types>", "numLanes of type 'a' is '-2'"),
        ("nodes", "<edges/>", "begins with <edges>; a file of nodes begins with <nodes>"),
    ],
    ids=lambda value: value[:30] if len(value) > 5 else value,
)
def test_bad_files_are_one_line(tmp_path, kind, text, line):
    source = tmp_path / "source"
    source.write_text(text)
    with pytest.raises(TrafficError) as caught:
        checked_copy(source, tmp_path / "copy", kind)
    assert str(caught.value).startswith(f"{source}: {line}")
    assert "\n" not in str(caught.value)


def test_a_length_of_minus_one_means_not_given(tmp_path):
    (tmp_path / "e").write_text("<edges><edge id='a' length='-1' width='-1'/></edges>")
    assert checked_copy(tmp_path / "e", tmp_path / "copy", "edges").counts["edge"] == 1


def test_damaged_and_missing_files(tmp_path):
    packed = gzip.compress(osm_extract().encode())
    cases = {
        "short.gz": packed[:-300],
        "flipped.gz": packed[:60] + b"\x00\xff" + packed[62:],
        "latin.osm": b"<osm>\xff</osm>",
    }
    for name, content in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(TrafficError, match=name):
            checked_copy(tmp_path / name, tmp_path / "copy", "osm")
    with pytest.raises(TrafficError, match=r"none.osm: cannot be read: No such file"):
        checked_copy(tmp_path / "none.osm", tmp_path / "copy", "osm")
    with zipfile.ZipFile(tmp_path / "extract.zip", "w") as archive:
        archive.writestr("extract.osm", osm_extract())
    with pytest.raises(TrafficError, match="is not XML"):
        checked_copy(tmp_path / "extract.zip", tmp_path / "copy", "osm")


def test_a_decompression_bomb_stops_at_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(xml, "MAX_BYTES", 100_000)
    (tmp_path / "bomb.gz").write_bytes(gzip.compress(b"<osm>" + b" " * 10_000_000))
    with pytest.raises(TrafficError, match="is longer than"):
        checked_copy(tmp_path / "bomb.gz", tmp_path / "copy", "osm")
    assert (tmp_path / "copy").stat().st_size <= 100_000

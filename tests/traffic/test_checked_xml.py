"""Files from outside: bad ones are refused, good ones are copied completely."""

import bz2
import gzip
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.deadlines import within
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
        ("net", NET.replace("</net>", "<edge id='e'><lane/></edge></net>"), "holds edge 'e' twice; ids must differ"),
        ("net", NET.replace("</net>", "<junction id='j'/></net>"), "holds junction 'j' twice; ids must differ"),
        ("net", NET.replace(' id="e"', ""), "has an element <edge> without an id"),
        ("net", NET.replace("</net>", "<edge id='f'/></net>"), "holds edge 'f', which has no lanes"),
        ("net", NET.replace('id="j"', 'id="j" x="nan" y="0"'), "x of junction 'j' is 'nan'; it should hold metres"),
        ("net", NET.replace('id="j"', 'id="j" x="1e300"'), "x of junction 'j' is '1e300'; it should hold metres"),
        (
            "net",
            NET.replace("/></edge>", " shape='0,0 inf,1'/></edge>"),
            "shape of lane 'e_0' is '0,0 inf,1'; it should",
        ),
        (
            "net",
            NET.replace("/></edge>", " shape='here'/></edge>"),
            "shape of lane 'e_0' is 'here'; it should hold metres",
        ),
        (
            "nodes",
            "<nodes><node id='a' x='0' y='inf'/></nodes>",
            "y of node 'a' is 'inf'; it should hold metres, numbers",
        ),
        (
            "edges",
            "<edges><edge id='a' shape='0,0 nan,1'/></edges>",
            "shape of edge 'a' is '0,0 nan,1'; it should hold",
        ),
        (
            "edges",
            "<edges><edge id='a' numLanes='9999999'/></edges>",
            "numLanes of edge 'a' is '9999999'; give at most",
        ),
        (
            "osm",
            "<osm><way id='5'><tag k='lanes' v='9999999'/></way></osm>",
            "way 5: lanes is '9999999'; give at most 100",
        ),
        (
            "osm",
            f"<osm><way id='5'><tag k='lanes:forward' v='{'9' * 5000}'/></way></osm>",
            "way 5: lanes:forward is '99",
        ),
        (
            "osm",
            '<?xml version="1.0" encoding="klingon"?><osm/>',
            "is in an encoding that is not known (unknown encoding: klingon); save it as UTF-8",
        ),
        ("osm", '<?xml version="1.0" encoding="utf-7"?><osm/>', "is "),
        ("osm", "<osm>" + "<tag>" * 50 + "</tag>" * 50 + "</osm>", "nests elements more than 40 deep"),
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


def test_lanes_that_are_no_number_and_coordinates_with_heights_are_left_to_sumo(tmp_path):
    (tmp_path / "m").write_text("<osm><way id='5'><tag k='lanes' v='2;3'/><tag k='lanes' v='4'/></way></osm>")
    assert checked_copy(tmp_path / "m", tmp_path / "copy", "osm").counts["tag"] == 2
    (tmp_path / "e").write_text("<edges><edge id='a' shape='0,0,3 1.5,-2,4'/><edge id='a' shape=''/></edges>")
    assert checked_copy(tmp_path / "e", tmp_path / "copy", "edges").counts["edge"] == 2


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


NODE = b'<node id="1" lat="50.000000" lon="9.700000"/>'


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress], ids=["gzip", "bzip2"])
def test_a_bomb_of_valid_nodes_is_refused_with_little_written(tmp_path, monkeypatch, pack):
    monkeypatch.setattr(xml, "FREE_BYTES", 100_000)
    (tmp_path / "bomb.osm").write_bytes(pack(b"<osm>" + NODE * 40_000))
    with pytest.raises(TrafficError, match=r"bomb.osm: expands to more than 60 times its length; give it without comp"):
        checked_copy(tmp_path / "bomb.osm", tmp_path / "copy", "osm")
    assert (tmp_path / "copy").stat().st_size < 4e5


@pytest.mark.slow
def test_a_bomb_of_5_megabytes_is_refused_in_under_2_s(tmp_path):
    member = gzip.compress(NODE * 20_000)
    (tmp_path / "bomb.osm.gz").write_bytes(gzip.compress(b"<osm>") + member * (5_000_000 // len(member)))
    code = f"""
import time
from pathlib import Path
from uavmec_jax.errors import TrafficError
from uavmec_jax.traffic.checked_xml import checked_copy
start = time.process_time()
try:
    checked_copy(Path({str(tmp_path / "bomb.osm.gz")!r}), Path({str(tmp_path / "copy")!r}), "osm")
except TrafficError as error:
    assert "expands to more than 60 times its length" in str(error)
    print(time.process_time() - start)
"""  # in a process without the checks of types, which take much longer than the parser
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert float(done.stdout) < 2, done.stderr
    assert (tmp_path / "copy").stat().st_size < 10e6


def test_a_fifo_and_a_device_file_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with within(5):
        for source in (tmp_path / "pipe", Path("/dev/zero")):
            for kind in ("osm", "net", "nodes", "edges", "types"):
                with pytest.raises(TrafficError, match=f"{source}: cannot be read: is not a regular file"):
                    checked_copy(source, tmp_path / "copy", kind)


def test_a_nul_in_a_name_is_one_line(tmp_path):
    with pytest.raises(TrafficError, match="null byte"):
        checked_copy(Path("a\0b"), tmp_path / "copy", "osm")


def test_a_decompression_bomb_stops_at_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(xml, "MAX_BYTES", 100_000)
    (tmp_path / "bomb.gz").write_bytes(gzip.compress(b"<osm>" + b" " * 10_000_000))
    with pytest.raises(TrafficError, match="is longer than"):
        checked_copy(tmp_path / "bomb.gz", tmp_path / "copy", "osm")
    assert (tmp_path / "copy").stat().st_size <= 100_000

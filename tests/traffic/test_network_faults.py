"""With SUMO's reader: networks that are well-formed and strange are one line each (`pytest -m sumo`)."""

import re

import pytest

from uavmec_jax.errors import TrafficError
from uavmec_jax.traffic.network import build_network
from uavmec_jax.traffic.place import make_place
from uavmec_jax.traffic.workspace import Workspace

pytestmark = pytest.mark.sumo

NODES = """<nodes><node id="a" x="0" y="0"/><node id="b" x="100" y="0"/><node id="c" x="200" y="0"/></nodes>"""
EDGES = """<edges><edge id="ab" from="a" to="b" type="r"/><edge id="bc" from="b" to="c" type="r"/></edges>"""
TYPES = """<types><type id="r" numLanes="1" speed="13.9"/></types>"""


@pytest.fixture(autouse=True)
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def build(folder, nodes=NODES, edges=EDGES, types=TYPES):
    """Build a network of plain XML."""
    files = {"nodes": nodes, "edges": edges, "types": types}
    for kind, text in files.items():
        (folder / f"{kind}.xml").write_text(text)
    place = make_place({"name": "t", "network": {kind: f"{kind}.xml" for kind in files}}, "t")
    with Workspace() as workspace:
        network = build_network(place.network, folder, workspace)
        return network, network.file.read_text()


def read(folder, text):
    """Read a network that SUMO has built, or someone has changed."""
    (folder / "n.net.xml").write_text(text)
    with Workspace() as workspace:
        return build_network(make_place({"name": "t", "network": {"net": "n.net.xml"}}, "t").network, folder, workspace)


PLAIN = {
    "edge from an unknown junction": ({"edges": EDGES.replace('"a"', '"z"')}, "Edge's 'ab' from-node 'z' is not known"),
    "edge from nowhere": ({"edges": EDGES.replace('from="a"', "")}, "The from-node is not given for edge 'ab'"),
    "unknown type": ({"edges": EDGES.replace('"r"', '"q"')}, "Type 'q' used by edge 'ab' was not defined"),
    "no position": ({"nodes": NODES.replace('x="0"', "")}, "Missing position (at node ID='a')"),
    "no nodes": ({"nodes": "<nodes/>"}, "Edge's 'ab' from-node 'a' is not known"),
    "no edges": ({"edges": "<edges/>"}, ""),
    "id with a space": ({"nodes": NODES.replace('"a"', '"a a"')}, "Invalid node id 'a a'"),
}


@pytest.mark.parametrize(("files", "line"), PLAIN.values(), ids=PLAIN)
def test_strange_plain_networks_are_the_first_error_of_netconvert(tmp_path, files, line):
    with pytest.raises(TrafficError) as caught:
        build(tmp_path, **files)
    assert str(caught.value).startswith(f"{tmp_path / 'edges.xml'}: ")
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_loops_and_edges_of_no_length_are_built(tmp_path):
    edges = EDGES.replace("</edges>", '<edge id="bb" from="b" to="b" type="r"/><edge id="bd" from="b" to="d"/></edges>')
    network, _ = build(tmp_path, nodes=NODES.replace("</nodes>", '<node id="d" x="100" y="0"/></nodes>'), edges=edges)
    assert {"ab", "bc"} <= set(network.roads)
    assert all(road.length_m > 0 for road in network.roads.values())


def changed(text, pattern, replacement):
    """Replace the first match of a pattern."""
    new, count = re.subn(pattern, replacement, text, count=1, flags=re.DOTALL)
    assert count
    return new


LANE, JUNCTION = r'(<lane id="ab_0"[^>]*?)', r'(<junction id="a"[^>]*?)'

BUILT = {
    "edge from an unknown junction": (
        ('id="ab" from="a"', 'id="ab" from="z"'),
        "edge 'ab': begins at junction 'z', which does not exist",
    ),
    "edge to an unknown junction": (
        ('id="ab" from="a" to="b"', 'id="ab" from="a" to="z"'),
        "edge 'ab': ends at junction 'z', which does not exist",
    ),
    "edge from nowhere": (('id="ab" from="a"', 'id="ab"'), "edge 'ab': begins at no junction; give from and to"),
    "edge that is there twice": ((r'(<edge id="ab".*?</edge>)', r"\1\1"), "holds edge 'ab' twice; ids must differ"),
    "junction that is gone": (
        (r'<junction id="a".*?</junction>', ""),
        "edge 'ab': begins at junction 'a', which does not",
    ),
    "junction without a position": (
        (JUNCTION + r' x="[^"]*"', r"\1"),
        "is not a network that SUMO can read: 'x' is miss",
    ),
    "edge without lanes": ((r'(<edge id="ab"[^>]*>).*?</edge>', r"\1</edge>"), "holds edge 'ab', which has no lanes"),
    "lane without a shape": (
        (LANE + r' shape="[^"]*"', r"\1"),
        "edge 'ab': has a lane without a shape; give at least two",
    ),
    "lane of one point": ((LANE + r' shape="[^"]*"', r'\1 shape="1,2"'), "edge 'ab': has a lane without a shape"),
    "lane with NaN": ((LANE + r' shape="[^"]*"', r'\1 shape="1,2 nan,3"'), "shape of lane 'ab_0' is '1,2 nan,3'"),
    "lane without a speed": (
        (LANE + r' speed="[^"]*"', r"\1"),
        "is not a network that SUMO can read: 'speed' is missing",
    ),
    "connection of an unknown edge": (
        ('<connection from="ab"', '<connection from="z"'),
        "is not a network that SUMO can",
    ),
    "connection of an unknown lane": (
        ('fromLane="0"', 'fromLane="9"'),
        "is not a network that SUMO can read: list index",
    ),
    "no network": ((r"<net .*</net>", "<net/>"), "is not a network that SUMO can read: 'version' is missing"),
    "empty network": ((r"<net .*</net>", '<net version="1.20"/>'), "has no junctions with roads for cars between them"),
}


@pytest.mark.parametrize(("change", "line"), BUILT.values(), ids=BUILT)
def test_strange_networks_are_one_line(tmp_path, change, line):
    _, text = build(tmp_path)
    read(tmp_path, text)
    with pytest.raises(TrafficError) as caught:
        read(tmp_path, changed(text, *change))
    message = str(caught.value)
    assert message.removeprefix(f"{tmp_path}/").startswith(f"n.net.xml: {line}")
    assert "\n" not in message

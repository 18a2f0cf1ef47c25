"""Reading SUMO's output files (SUMO itself is not started)."""

import subprocess
import sys

import numpy as np
from numpy.testing import assert_array_equal

from uavmec_jax.traffic.simulation import Densities
from uavmec_jax.traffic.worker import _read_counts, _read_densities

DENSITY = """<meandata>
  <interval begin="120.00" end="420.00" id="density">
    <edge id="a" sampledSeconds="10.00" density="4.0" laneDensity="2.00"/>
    <edge id="b" sampledSeconds="0.00" laneDensity=""/>
    <edge id=":junction_0" laneDensity="99.0"/>
  </interval>
  <interval begin="420.00" end="720.00" id="density">
    <edge id="b" sampledSeconds="3.00"/>
    <edge id="c" laneDensity="7.5"/>
  </interval>
  <interval begin="720.00" end="730.00" id="density"><edge id="a" laneDensity="1.0"/></interval>
</meandata>"""


def test_empty_roads_have_density_0(tmp_path):
    (tmp_path / "d.xml").write_text(DENSITY)
    assert_array_equal(_read_densities(tmp_path / "d.xml", ["a", "b", "c"], 2), [[2, 0, 0], [0, 0, 7.5]])


def test_read_counts(tmp_path):
    text = '<s><vehicles loaded="9" inserted="8" running="2" waiting="1"/><teleports total="4" jam="3"/></s>'
    (tmp_path / "s.xml").write_text(text)
    assert _read_counts(tmp_path / "s.xml", 10) == {"loaded": 10, "unfinished": 4, "teleports": 4}  # one found no way
    assert set(_read_counts(tmp_path / "s.xml", 9)) | {"density"} == set(Densities.__annotations__)


def test_warnings_above_2_percent():
    def warnings(unfinished, teleports):
        counts = (np.array([100, 100]), np.array([unfinished, 0]), np.array([teleports, 0]))
        return Densities(np.zeros((2, 1, 1)), *counts).warnings()

    assert warnings(4, 4) == []
    assert warnings(5, 0) == ["2% of the vehicles had not left at the end; simulate longer"]
    assert warnings(0, 5) == ["2.5% of the vehicles were stuck and moved on by SUMO (teleports)"]


def test_a_worker_does_not_import_jax():
    code = "import sys, uavmec_jax.traffic.worker; assert not {'jax', 'pydantic'} & set(sys.modules), 'heavy'"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0

"""One simulation in a process of its own: ``python -m uavmec_jax.traffic.worker JOB.json``.

SUMO's library holds one simulation a process, and a crash of it must not be ours. Imports neither JAX nor the package's
other rooms; :mod:`uavmec_jax.traffic.simulation` starts it and reads what it leaves.
"""

import json
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np

_ADDITIONAL = """<additional>
  <edgeData id="density" file="{name}.density.xml" period="{window_s}" begin="{begin}" end="{end}"/>
</additional>
"""


def simulate(job: dict[str, Any]) -> None:
    """Run the simulation and write ``<name>.npz``: ``density [W, R]`` vehicles per km and lane, and the counts."""
    import libsumo

    name, end = job["name"], job["begin"] + job["window_s"] * job["windows"]
    Path(f"{name}.add.xml").write_text(
        _ADDITIONAL.format(name=name, begin=job["begin"], end=end, window_s=job["window_s"])
    )
    libsumo.start(
        [
            "sumo",
            *("--net-file", job["network"], "--route-files", job["trips"], "--additional-files", f"{name}.add.xml"),
            *("--statistic-output", f"{name}.statistics.xml", "--seed", str(job["seed"]), "--end", str(end)),
            *(
                "--device.rerouting.probability",
                str(job["rerouting"]),
                "--no-step-log",
                "true",
                "--no-warnings",
                "true",
            ),
            *("--xml-validation", "never", "--duration-log.disable", "true", "--ignore-route-errors", "true"),
        ]
    )
    libsumo.simulationStep(end)
    libsumo.close()
    density = _densities(Path(f"{name}.density.xml"), job["roads"], job["windows"])
    found: dict[str, Any] = {"density": density, **_counts(Path(f"{name}.statistics.xml"), job["drivers"])}
    np.savez(f"{name}.npz", **found)


def _densities(path: Path, roads: list[str], windows: int) -> np.ndarray:
    """Empty roads have no entry, or a blank one: 0."""
    column = {road: k for k, road in enumerate(roads)}
    density = np.zeros((windows, len(roads)), np.float32)
    window = -1
    for event, element in ElementTree.iterparse(path, events=("start", "end")):
        if event == "start":
            window += element.tag == "interval"
        elif element.tag == "edge":
            if element.get("id") in column and window < windows:
                density[window, column[element.attrib["id"]]] = float(element.get("laneDensity") or 0.0)
            element.clear()
    return density


def _counts(path: Path, drivers: int) -> dict[str, int]:
    """Drivers, those who had not arrived by the end (or found no way), and those whom SUMO moved because they were stuck."""
    root = ElementTree.parse(path).getroot()
    found = {tag: root.find(tag) for tag in ("vehicles", "teleports")}
    read = {tag: dict(element.attrib) if element is not None else {} for tag, element in found.items()}
    vehicles = {key: int(value) for key, value in read["vehicles"].items()}
    return {
        "loaded": drivers,
        "unfinished": drivers - vehicles.get("inserted", 0) + vehicles.get("running", 0),
        "teleports": int(read["teleports"].get("total", 0)),
    }


if __name__ == "__main__":
    try:
        simulate(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
    except Exception as error:  # SUMO's own, over several lines; it has already said what it has no words for here
        words = " ".join(str(error).split())
        sys.exit(f"Error: {words}" if words and "proxy of" not in words else 1)

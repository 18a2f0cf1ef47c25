"""One simulation in its own process: ``python -m uavmec_jax.traffic.worker JOB.json``.

SUMO's library holds one simulation per process, and a crash in it must not take the caller down.
:mod:`uavmec_jax.traffic.simulation` starts this process and reads its result. Neither JAX nor the other subpackages are
imported here, so that it starts quickly.
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
    options = {
        "--net-file": job["network"],
        "--route-files": job["trips"],
        "--additional-files": f"{name}.add.xml",
        "--statistic-output": f"{name}.statistics.xml",
        "--seed": str(job["seed"]),
        "--end": str(end),
        "--device.rerouting.probability": str(job["rerouting"]),
        "--no-step-log": "true",
        "--no-warnings": "true",
        "--xml-validation": "never",
        "--duration-log.disable": "true",
        "--ignore-route-errors": "true",
    }
    libsumo.start(["sumo", *(part for option in options.items() for part in option)])
    libsumo.simulationStep(end)
    libsumo.close()
    results: dict[str, Any] = {
        "density": _read_densities(Path(f"{name}.density.xml"), job["roads"], job["windows"]),
        **_read_counts(Path(f"{name}.statistics.xml"), job["vehicles"]),
    }
    np.savez(f"{name}.npz", **results)


def _read_densities(path: Path, roads: list[str], windows: int) -> np.ndarray:
    """Read the density ``[W, R]`` of every road in every window; a road without traffic has no entry, or a blank one."""
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


def _read_counts(path: Path, trips: int) -> dict[str, int]:
    """Count the vehicles.

    Args:
        path: SUMO's statistics.
        trips: number of trips that SUMO was given.

    Returns:
        ``loaded``, all trips; ``unfinished``, those that had not arrived by the end or found no way; ``teleports``, vehicles
        that SUMO moved because they were stuck.
    """
    root = ElementTree.parse(path).getroot()
    elements = {tag: root.find(tag) for tag in ("vehicles", "teleports")}
    statistics = {tag: dict(element.attrib) if element is not None else {} for tag, element in elements.items()}
    vehicles = {key: int(value) for key, value in statistics["vehicles"].items()}
    return {
        "loaded": trips,
        "unfinished": trips - vehicles.get("inserted", 0) + vehicles.get("running", 0),
        "teleports": int(statistics["teleports"].get("total", 0)),
    }


if __name__ == "__main__":
    try:
        simulate(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
    except Exception as error:
        message = " ".join(str(error).split())  # SUMO's messages span several lines
        # libsumo's "proxy of" messages are empty wrappers: SUMO has already printed the error itself.
        sys.exit(f"Error: {message}" if message and "proxy of" not in message else 1)

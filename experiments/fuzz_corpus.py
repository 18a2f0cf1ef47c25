"""Valid files of every kind, small, from which inputs are mutated; runs are made by running a tiny study."""

import json
import shutil
from collections.abc import Sequence
from contextlib import suppress
from importlib import resources
from pathlib import Path
from typing import Any
from unittest import mock

from uavmec_jax.runs.run import resume_run, run_study
from uavmec_jax.scenarios.scenario_files import load_scenario_file
from uavmec_jax.scenarios.state_files import state_data
from uavmec_jax.search.halving import TrialOutcome
from uavmec_jax.search.search import run_search
from uavmec_jax.search.space import load_space
from uavmec_jax.studies.study import load_study

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"

STUDY = """
name = "tiny"
algorithm = "a2c"
reward = "U"
steps = 600
[axes]
powered = [12, 4]
connected = [8]
seeds = 2
[a2c]
hidden = [4]
[evaluation]
draws = 2
validate_every = 200
validation_draws = 2
planners = ["bound"]
planner_draws = 1
clairvoyant_seeds = [0, 1]
baselines = ["oldest-first"]
"""

SPACE = """
name = "tiny-search"
study = "tiny.toml"
trials = 4
batch = 2
[change]
steps = 400
[validation]
seeds = 2
cells = [[12, 8]]
draws = 3
[halving]
rungs = [0.3]
[space]
learning_rate = { low = 1e-4, high = 1e-1, log = true }
hidden = { choices = [[8], [4, 4]] }
"reward.M" = { low = 0.0, high = 1.0 }
"""

DEVICES = """
[[device]]
name = "north"
junction = "a"
[[device]]
name = "south"
x_m = 10.5
y_m = 20.0
"""

XML = {
    "osm": """<osm version="0.6"><bounds minlat="50" minlon="9" maxlat="51" maxlon="10"/>
<node id="1" lat="50.1" lon="9.1"/><node id="2" lat="50.2" lon="9.2"><tag k="highway" v="stop"/></node>
<way id="7"><nd ref="1"/><nd ref="2"/><tag k="highway" v="residential"/><tag k="name" v="Elm"/></way>
<relation id="9"><member type="way" ref="7" role=""/></relation></osm>""",
    "net": """<net version="1.20"><location netOffset="0.00,0.00" convBoundary="0.00,0.00,100.00,0.00"
 origBoundary="0.00,0.00,100.00,0.00" projParameter="!"/>
<type id="highway.residential" priority="3" numLanes="1" speed="13.89"/>
<edge id="e" from="a" to="b" priority="3" type="highway.residential"><lane id="e_0" index="0" speed="13.90" length="100.00"
 shape="0.00,0.00 100.00,0.00"/></edge>
<edge id="f" from="b" to="a" priority="3" type="highway.residential"><lane id="f_0" index="0" speed="13.90" length="100.00"
 shape="100.00,0.00 0.00,0.00"/></edge>
<junction id="a" type="priority" x="0.00" y="0.00" incLanes="f_0" intLanes="" shape="0.00,0.00"/>
<junction id="b" type="priority" x="100.00" y="0.00" incLanes="e_0" intLanes="" shape="100.00,0.00"/>
<connection from="e" to="f" fromLane="0" toLane="0" dir="t" state="M"/></net>""",
    "nodes": '<nodes><node id="a" x="0" y="0"/><node id="b" x="100.0" y="0.0" type="priority"/></nodes>',
    "edges": '<edges><edge id="e" from="a" to="b" numLanes="1" speed="13.9" type="r"/><edge id="f" from="b" to="a"/></edges>',
    "types": '<types><type id="r" priority="3" numLanes="1" speed="13.89" width="3.2"/></types>',
}
"""One file of each kind of map and road network."""


class InstantHalving:
    """Stands in for the training of a batch: its trials have values at once."""

    def __init__(self, space: Any, *_: Any) -> None:
        self.space = space

    def run(self, trials: Sequence[Any]) -> list[TrialOutcome]:
        """Return the values of a batch."""
        return [TrialOutcome(10.0 + place, {200: 9.0}) for place, _ in enumerate(trials)]


class _Stopped(KeyboardInterrupt):
    """The run is far enough."""


def make_corpus(folder: Path) -> None:
    """Make the corpus in a new folder: ``tables`` with single files, ``young`` and ``finished`` runs, a ``search``."""
    tables = folder / "tables"
    tables.mkdir(parents=True)
    (tables / "tiny.toml").write_text(STUDY)
    (tables / "space.toml").write_text(SPACE)
    (tables / "devices.toml").write_text(DEVICES)
    for kind, text in XML.items():
        (tables / f"{kind}.xml").write_text(text)
    for name in ("harbour.toml", "harbour_fleet.toml", "village.csv"):
        shutil.copy(EXAMPLES / name, tables)
        state = json.dumps(state_data(load_scenario_file(EXAMPLES / name)))
        (tables / f"{Path(name).stem}_state.json").write_text(state)
    places = resources.files("uavmec_jax.traffic") / "places"
    for name in ("albany", "round_lake"):
        (tables / f"{name}.npz").write_bytes((places / name / "evacuation.npz").read_bytes())
        (tables / f"{name}.toml").write_bytes((places / name / "place.toml").read_bytes())
    _run(load_study(tables / "tiny.toml"), folder)
    shutil.copy(folder / "finished" / "weights.npz", tables)
    space = load_space(str(tables / "space.toml"), {"study": str(tables / "tiny.toml")})
    with mock.patch("uavmec_jax.search.search.SuccessiveHalving", InstantHalving):
        run_search(space, folder / "search")


def _run(study: Any, folder: Path) -> None:
    """Run a study in two shards: stop it with a result of the first and a checkpoint of the second, and end a copy."""
    seen = set()

    def stop(progress: Any) -> None:
        seen.add(progress.shard)
        if len(seen) == 2:
            raise _Stopped

    with suppress(_Stopped):
        run_study(study, folder / "young", shard_size=2, on_progress=stop)
    shutil.copytree(folder / "young", folder / "finished")
    resume_run(folder / "finished")


def library(package: str) -> list[bytes]:
    """Return the TOML files that ship with a package."""
    files = (resources.files(package) / "library").iterdir()
    return [file.read_bytes() for file in sorted(files, key=lambda file: file.name) if file.name.endswith(".toml")]

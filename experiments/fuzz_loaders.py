"""What is done with every input: it is loaded as the package loads it, and used a little."""

import io
import json
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from fuzz_corpus import InstantHalving
from fuzz_judge import Refused, not_finite
from rich.console import Console

from uavmec_jax.env.dynamics import transition
from uavmec_jax.reporting.evacuation import evacuation_data, evacuation_lines, evacuation_table
from uavmec_jax.reporting.status import status_lines
from uavmec_jax.reporting.summary import summary
from uavmec_jax.reporting.tables import tables
from uavmec_jax.runs.checkpoints import Checkpoints
from uavmec_jax.runs.folder import RunFolder
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.runs.shard_runner import ShardRunner
from uavmec_jax.runs.status import run_status
from uavmec_jax.scenarios.policies import load_policy
from uavmec_jax.scenarios.scenario_files import load_scenario_file, scenario_text
from uavmec_jax.scenarios.state_files import load_state
from uavmec_jax.search.search import run_search
from uavmec_jax.search.space import baseline_settings, identity, load_space
from uavmec_jax.studies.population import n_agents
from uavmec_jax.studies.study import load_study, parse_study, study_toml
from uavmec_jax.traffic.checked_xml import checked_copy
from uavmec_jax.traffic.evacuation import load_evacuation
from uavmec_jax.traffic.network import read_network
from uavmec_jax.traffic.place import load_place


def use_study(folder: Path) -> Any:
    """Load a study, and write and read it again."""
    study = load_study(folder / "tiny.toml")
    assert n_agents(study) >= 0
    assert parse_study(study_toml(study), "again") == study, "a study that is written is another one when it is read"
    return study


def use_space(folder: Path) -> Any:
    """Load a search space."""
    space = load_space("space.toml")
    return space, identity(space), baseline_settings(space)


def use_scenario(folder: Path) -> Any:
    """Load a scenario or an inventory, and play a slot."""
    path = next(folder.iterdir(), folder / "missing.toml")
    named = load_scenario_file(path)
    scenario_text(named)
    return named, _one_slot(named.params, named.layout, named.state)


def _is_chosen(path: Path) -> bool:
    """Return whether a file is one of the share that is used more than a little, which takes time."""
    return path.is_file() and zlib.crc32(path.read_bytes()) % 4 == 0


_KNOWN_SHAPES: set[Any] = set()
_MOST_SHAPES = 12
_play = jax.jit(lambda params, layout, state, action, volumes: transition(params, layout, state, action, volumes))


def _one_slot(params: Any, layout: Any, state: Any) -> Any:
    """Play one slot, unless that would compile yet another program."""
    shapes = str(jax.tree.map(jnp.shape, (params, layout, state))) + str(jax.tree.structure((params, layout)))
    if shapes not in _KNOWN_SHAPES and len(_KNOWN_SHAPES) >= _MOST_SHAPES:
        return None
    _KNOWN_SHAPES.add(shapes)
    volumes = jnp.full(layout.n_devices, params.task_volume_range_bytes[1], jnp.float32)
    return _play(params, layout, state, jnp.zeros(layout.action_shape, jnp.int32), volumes)


@cache
def _scenario(path: Path) -> Any:
    return load_scenario_file(path)


def use_state(single: Path, name: str, folder: Path) -> Any:
    """Load a state, and play a slot from it."""
    scenario = _scenario(single / f"{name}.{'csv' if name == 'village' else 'toml'}")
    state = load_state(folder / "s.json", scenario)
    return state, _one_slot(scenario.params, scenario.layout, state)


def use_place(folder: Path) -> Any:
    """Load a place."""
    return load_place(folder / "p.toml")[0]


def use_evacuation(folder: Path) -> Any:
    """Load an evacuation, and show it."""
    evacuation = load_evacuation(folder / "e.npz")
    console = Console(file=io.StringIO())
    console.print(f"[bold]{evacuation.name}[/bold]: {evacuation.meta['description']}", highlight=False)
    console.print(evacuation_table(evacuation))
    for weights in (evacuation.weight, evacuation.window_weight):
        assert ((weights >= 0) & (weights <= 1)).all(), "a traffic weight is not in [0, 1]"
    with suppress(ValueError):  # a hop may be too long
        evacuation.check_hops(5.0, 600.0)
    data = json.loads(json.dumps(evacuation_data(evacuation)))
    return evacuation, data, evacuation_lines(evacuation), evacuation.region_m(1000.0), evacuation.mean_road_density


def use_policy(folder: Path) -> Any:
    """Load a policy from the weights of a run."""
    policy: Any = load_policy(folder / "w.npz", powered=12, connected=8, seed=0)
    return policy.collection.weights, policy.collection.settings, dict(policy.trained_on), policy.n_devices


def use_unfinished(file: str, folder: Path) -> Any:
    """Load a run that is not finished, and show its status."""
    run, status = RunFolder.open(folder), run_status(folder)
    json.dumps(status.as_json())
    shown = run.plan, run.plan.shards, str(run.plan), run.options, status, status_lines(status)
    return shown, load_results(folder).run if _is_chosen(folder / file) else run.study


def use_shard(file: str, folder: Path) -> Any:
    """Load the results of the shards of a run that are finished."""
    assert (folder / file).parent.is_dir()
    results = load_results(folder)
    return results.agents, results.curves, results.evaluation


def make_restorer(young: Path) -> Callable[[str, Path], Any]:
    """Return what restores a shard from a checkpoint; its training is compiled when it is first needed."""

    @cache
    def trained() -> Any:
        run = RunFolder.open(young)
        return run, ShardRunner(run.study, run.plan), run.plan.shards[1]

    def restore(file: str, folder: Path) -> Any:
        run, runner, shard = trained()
        events: list[tuple[str, Any]] = []
        identity = {"run": run.fingerprint, "shard": shard.number, "agents": shard.agents}

        def log(event: str, **facts: Any) -> None:
            events.append((event, facts))

        checkpoints = Checkpoints(
            (folder / file).parent, "full", 0.0, 1.0, 0, identity, "x", log, lambda weights: weights
        )
        training = checkpoints.resume(lambda: runner.start(shard))
        if events and events[0][0] == "damaged":
            raise Refused(str(events[0][1]["error"]))
        return training.seconds, training.chunks_done, np.asarray(training.steps)

    return restore


def use_finished(file: str, folder: Path) -> Any:
    """Load a finished run, and show it."""
    results, console = load_results(folder), Console(file=io.StringIO())
    if not _is_chosen(folder / file):
        return results.agents, results.curves, results.evaluation
    for table in tables(results).values():
        console.print(table)
    summary(results)
    assert not not_finite(results.cells(), frozenset(), may_be_nan=True), "a mean is infinite"
    return results.agents, results.curves, results.evaluation


@cache
def _search_space(single: Path) -> Any:
    return load_space(str(single / "space.toml"), {"study": str(single / "tiny.toml")})


def use_search(single: Path, file: str, folder: Path) -> Any:
    """Continue a search whose trials need no time."""
    with mock.patch("uavmec_jax.search.search.SuccessiveHalving", InstantHalving):
        result = run_search(_search_space(single), folder)
    return result.best, result.importance


def use_xml(kind: str, copy: Path, folder: Path) -> Any:
    """Check a map or a road network, and read it if SUMO is installed."""
    contents = checked_copy(folder / "m.xml", copy, kind)
    bounds = contents.west, contents.south, contents.east, contents.north
    assert not any(side != side for side in bounds), "the extent is NaN"
    if kind == "net" and find_spec("sumolib") is not None:
        return list(read_network(copy, "m.xml").roads.values())
    return contents.counts

"""Simulate an evacuation with several seeds, each in its own process."""

import json
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from uavmec_jax.errors import TrafficError
from uavmec_jax.files.archives import load_arrays
from uavmec_jax.traffic import sumo
from uavmec_jax.traffic.demand import Routes, write_trips
from uavmec_jax.traffic.network import RoadNetwork
from uavmec_jax.traffic.place import Demand, Simulation
from uavmec_jax.traffic.workspace import Workspace

MAX_DENSITIES = 2**28
"""Most densities of all simulations together: 1 GiB."""

_WARNING_SHARE = 0.02
"""Share of the vehicles that may be unfinished, or teleported, without a warning."""


@dataclass(frozen=True)
class Densities:
    """Results of ``S`` simulations on ``R`` roads in ``W`` windows.

    Attributes:
        density: ``[S, W, R]`` vehicles per km and lane, means over a window.
        loaded: ``[S]`` vehicles of the demand.
        unfinished: ``[S]`` vehicles that had not left by the end, or found no way.
        teleports: ``[S]`` vehicles that SUMO moved because they were stuck.
    """

    density: Float[np.ndarray, "S W R"]
    loaded: Int[np.ndarray, " S"]
    unfinished: Int[np.ndarray, " S"]
    teleports: Int[np.ndarray, " S"]

    def warnings(self) -> list[str]:
        """Return a line for each thing that makes the densities doubtful."""
        loaded, lines = self.loaded.sum(), []
        if self.unfinished.sum() > _WARNING_SHARE * loaded:
            lines.append(
                f"{self.unfinished.sum() / loaded:.0%} of the vehicles had not left at the end; simulate longer"
            )
        if self.teleports.sum() > _WARNING_SHARE * loaded:
            lines.append(
                f"{self.teleports.sum() / loaded:.1%} of the vehicles were stuck and moved on by SUMO (teleports)"
            )
        return lines


def simulate(
    network: RoadNetwork,
    routes: Routes,
    demand: Demand,
    simulation: Simulation,
    workspace: Workspace,
    on_done: Callable[[int], None] = lambda _: None,
) -> Densities:
    """Simulate with seeds 0, 1, ..., as many at a time as there are cores.

    Args:
        network: its file lies in the workspace.
        routes: origins and exits.
        demand: vehicles and departure times.
        simulation: number of seeds, duration, windows.
        workspace: all files are written there.
        on_done: called with the number of finished simulations.

    Raises:
        TrafficError: SUMO is missing, failed (the message is its first error) or took too long.
    """
    sumo.version()  # fails before anything is written if SUMO is missing
    numbers = simulation.seeds * simulation.n_windows * len(network.roads)
    if numbers > MAX_DENSITIES:
        raise TrafficError(
            f"simulation: {simulation.seeds} seeds, {simulation.n_windows} windows and {len(network.roads):,} roads make "
            f"{numbers:.3g} densities; at most {MAX_DENSITIES:.3g} are kept; give fewer seeds or longer windows"
        )
    jobs = [_write_job(seed, network, routes, demand, simulation, workspace) for seed in range(simulation.seeds)]
    with ThreadPoolExecutor(max_workers=min(simulation.seeds, os.cpu_count() or 1)) as pool:
        futures = [pool.submit(_run_job, job, simulation.time_limit_s, workspace) for job in jobs]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                on_done(done)
        except BaseException:  # Ctrl-C too: start none of the waiting jobs, end the running ones
            pool.shutdown(wait=False, cancel_futures=True)
            workspace.stop()
            raise
    results = [_read_result(future.result()) for future in futures]
    return Densities(**{name: np.stack([result[name] for result in results]) for name in Densities.__annotations__})


def _write_job(
    seed: int, network: RoadNetwork, routes: Routes, demand: Demand, simulation: Simulation, workspace: Workspace
) -> Path:
    """Write the trips and the settings of one simulation; return the path of the settings."""
    name = f"simulation-{seed}"
    trips = write_trips(
        workspace.folder / f"{name}.trips.xml", routes, demand, simulation.n_windows * simulation.window_s, seed
    )
    if not trips:
        raise TrafficError(
            f"demand: no vehicle departs within {simulation.duration_s:g} s; give more vehicles or a longer time"
        )
    job = {
        "name": name,
        "network": network.file.name,
        "trips": f"{name}.trips.xml",
        "vehicles": trips,
        "seed": seed,
        "begin": demand.warm_up_s,
        "window_s": simulation.window_s,
        "windows": simulation.n_windows,
        "rerouting": demand.rerouting,
        "roads": list(network.roads),
    }
    path = workspace.folder / f"{name}.json"
    path.write_text(json.dumps(job), encoding="utf-8")
    return path


def _run_job(job: Path, limit_s: float, workspace: Workspace) -> Path:
    """Run one simulation in a process of its own; return the path of its result."""
    packages = str(Path(__file__).parents[2])
    env = {
        **sumo.environment(),
        "PYTHONPATH": os.pathsep.join([packages, os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep),
    }
    worker = [sys.executable, "-P", "-m", "uavmec_jax.traffic.worker"]  # -P: no module of the folder it runs in
    workspace.run("SUMO", [*worker, job], limit_s=limit_s, env=env)
    return job.with_suffix(".npz")


def _read_result(path: Path) -> dict[str, np.ndarray]:
    arrays = load_arrays(path)
    return {name: arrays[name] for name in Densities.__annotations__}

"""Simulate an evacuation several times, one process each, and average."""

import json
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uavmec_jax.errors import TrafficError
from uavmec_jax.traffic import sumo
from uavmec_jax.traffic.demand import Routes, write_trips
from uavmec_jax.traffic.network import RoadNetwork
from uavmec_jax.traffic.place import Demand, Simulation
from uavmec_jax.traffic.workspace import Workshop


@dataclass(frozen=True)
class Densities:
    """What ``S`` simulations found on ``R`` roads in ``W`` windows.

    Attributes:
        density: ``[S, W, R]`` vehicles per km and lane, means over a window.
        loaded, unfinished, teleports: ``[S]`` vehicles that should have driven, had not left by the end (or found no way),
            and were moved on by SUMO because they were stuck.
    """

    density: np.ndarray
    loaded: np.ndarray
    unfinished: np.ndarray
    teleports: np.ndarray

    def warnings(self) -> list[str]:
        """What a reader of the densities should know: lines, or none."""
        loaded, lines = self.loaded.sum(), []
        if self.unfinished.sum() > 0.02 * loaded:
            lines.append(
                f"{self.unfinished.sum() / loaded:.0%} of the vehicles had not left at the end; simulate longer"
            )
        if self.teleports.sum() > 0.02 * loaded:
            lines.append(
                f"{self.teleports.sum() / loaded:.1%} of the vehicles were stuck and moved on by SUMO (teleports)"
            )
        return lines


def simulate(
    network: RoadNetwork,
    routes: Routes,
    demand: Demand,
    simulation: Simulation,
    workshop: Workshop,
    on_done: Callable[[int], None] = lambda _: None,
) -> Densities:
    """Simulate with seeds 0, 1, ..., as many at a time as there are cores.

    Args:
        network: its file lies in the workshop.
        routes: origins and exits.
        demand: who drives.
        simulation: how often, how long.
        workshop: where everything is written.
        on_done: told how many simulations are done.

    Raises:
        TrafficError: SUMO is missing, failed (its last line of error) or took too long.
    """
    sumo.version()
    jobs = [_prepare(seed, network, routes, demand, simulation, workshop) for seed in range(simulation.seeds)]
    with ThreadPoolExecutor(max_workers=min(simulation.seeds, os.cpu_count() or 1)) as pool:
        running = [pool.submit(_run, job, simulation.time_limit_s, workshop) for job in jobs]
        try:
            for done, one in enumerate(as_completed(running), 1):
                one.result()
                on_done(done)
        except BaseException:  # Ctrl-C too: what waits is not started, what runs is ended
            pool.shutdown(wait=False, cancel_futures=True)
            workshop.stop()
            raise
    found = [_read(one.result()) for one in running]
    return Densities(**{name: np.stack([each[name] for each in found]) for name in Densities.__annotations__})


def _prepare(
    seed: int, network: RoadNetwork, routes: Routes, demand: Demand, simulation: Simulation, workshop: Workshop
) -> Path:
    name = f"simulation-{seed}"
    trips = write_trips(
        workshop.folder / f"{name}.trips.xml", routes, demand, simulation.n_windows * simulation.window_s, seed
    )
    if not trips:
        raise TrafficError(
            f"demand: nobody drives within {simulation.duration_s:g} s; give more vehicles or a longer time"
        )
    job = {
        "name": name,
        "network": network.file.name,
        "trips": f"{name}.trips.xml",
        "drivers": trips,
        "seed": seed,
        "begin": demand.warm_up_s,
        "window_s": simulation.window_s,
        "windows": simulation.n_windows,
        "rerouting": demand.rerouting,
        "roads": list(network.roads),
    }
    path = workshop.folder / f"{name}.json"
    path.write_text(json.dumps(job), encoding="utf-8")
    return path


def _run(job: Path, limit_s: float, workshop: Workshop) -> Path:
    packages = str(Path(__file__).parents[2])
    env = {
        **sumo.environment(),
        "PYTHONPATH": os.pathsep.join([packages, os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep),
    }
    workshop.run("SUMO", [sys.executable, "-m", "uavmec_jax.traffic.worker", job], limit_s=limit_s, env=env)
    return job.with_suffix(".npz")


def _read(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in Densities.__annotations__}

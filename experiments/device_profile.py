"""Where the time of training goes on a GPU: kernels per iteration, how busy the GPU is, and the longest kernels."""

import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import jax
import numpy as np

from uavmec_jax.studies.population import make_agents, make_algorithm, validation_keys
from uavmec_jax.studies.study import parse_study
from uavmec_jax.training.programs import Programs, make_mesh, put_on_mesh

ITERATIONS = 20
"""Iterations that are profiled."""


def profile_training(agents: int = 750, algorithm: str = "dqn") -> dict[str, Any]:
    """Profile some iterations of training ``agents`` agents on the first GPU."""
    axes = f"[axes]\npowered = [8]\nconnected = [8]\nseeds = {agents}"
    study = parse_study(f"algorithm = '{algorithm}'\nsteps = 100000\n{axes}", "profile")
    bound = make_algorithm(study)
    assert bound is not None
    mesh = make_mesh(1)
    population = make_agents(study), validation_keys(study)
    programs = Programs.compile(bound, mesh, population)
    placed = put_on_mesh(mesh, population[0])
    state = programs.update(placed, programs.init(placed), np.int32(0), np.int32(200))
    state = jax.block_until_ready(programs.update(placed, state, np.int32(200), np.int32(400)))
    tick = time.perf_counter()
    state = jax.block_until_ready(programs.update(placed, state, np.int32(400), np.int32(800)))
    unprofiled = (time.perf_counter() - tick) / 400
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(programs.update(placed, state, np.int32(800), np.int32(800 + ITERATIONS)))
        trace = next(Path(folder).rglob("*.xplane.pb"))
        events = device_events(trace)
    report = {"agents": agents, "algorithm": algorithm, "microseconds_per_iteration": round(1e6 * unprofiled, 1)}
    report |= summarize(events)
    print(f"profile of {algorithm}, {agents} agents: {report['microseconds_per_iteration']} us per iteration, ", end="")
    print(f"{report['kernels_per_iteration']} kernels, busy {report['busy_share']:.0%}", flush=True)
    for row in report["longest"]:
        print(f"  {row['share']:>6.1%} {row['per_iteration']:>7.1f} x {row['microseconds']:>7.2f} us  {row['kernel']}")
    return report


def device_events(trace: Path) -> list[tuple[str, float, float]]:
    """Return name, start and duration (ns) of everything that ran on a stream of a GPU."""
    data: Any = jax.profiler.ProfileData.from_file(str(trace))
    return [
        (event.name, event.start_ns, event.duration_ns)
        for plane in data.planes
        if plane.name.startswith("/device:GPU")
        for line in plane.lines
        if line.name.startswith("Stream")
        for event in line.events
    ]


def summarize(events: list[tuple[str, float, float]], longest: int = 25) -> dict[str, Any]:
    """Summarize device events: how many there are per iteration, how busy the GPU is, and the longest by name."""
    if not events:
        return {"kernels_per_iteration": 0, "busy_share": 0.0, "longest": []}
    total = sum(duration for _, _, duration in events)
    span = max(start + duration for _, start, duration in events) - min(start for _, start, _ in events)
    time_of, count_of = Counter[str](), Counter[str]()
    for name, _, duration in events:
        time_of[name] += duration  # type: ignore[assignment]
        count_of[name] += 1
    rows = [
        {
            "kernel": name[:100],
            "share": round(spent / total, 4),
            "per_iteration": round(count_of[name] / ITERATIONS, 2),
            "microseconds": round(spent / count_of[name] / 1e3, 2),
        }
        for name, spent in time_of.most_common(longest)
    ]
    kernels = round(len(events) / ITERATIONS, 1)
    return {"kernels_per_iteration": kernels, "busy_share": round(total / span, 3), "longest": rows}

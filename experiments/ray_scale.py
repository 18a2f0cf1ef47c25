"""What Ray costs and brings: overhead for each of many shards, and the wall time of a study on one, two and four nodes.

    uv run python experiments/ray_scale.py [--shards 10000] [--out results/ray]

1. A driver with 10,000 shards on four nodes. In place of training, each shard writes an empty result: what remains is
   scheduling, the driver's work and the files. Also measured: its memory, and the time that `uavmec status` takes.
2. A real study in eight shards on one, two and four nodes, each pinned to one core, beside what `--simulate` says for the
   speed of one process on one core. With fewer cores than nodes, nodes share them.

Nodes are processes of this machine. Writes `scale.json`.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
from reports import write_report
from simulated_nodes import SimulatedNodes

from uavmec_jax.cluster.connection import connect
from uavmec_jax.cluster.options import RayOptions

SETTINGS = ["axes.seeds=4", "steps=400000", "evaluation.planners=[]", "axes.powered=[12,4]", "axes.connected=[8,4]"]
SHARD_SIZE = 2
NODES = (1, 2, 4)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shards", type=int, default=10_000)
    parser.add_argument("--steps", type=int, help="of the real study, for a test of the script")
    parser.add_argument("--nodes", type=int, nargs="+", default=NODES)
    parser.add_argument("--work", type=Path, default=Path("runs/ray-scale"))
    parser.add_argument("--out", type=Path, default=Path("results/ray"))
    arguments = parser.parse_args()
    work = arguments.work.absolute()
    work.mkdir(parents=True)
    settings = [*SETTINGS, *([f"steps={arguments.steps}"] if arguments.steps else [])]
    stubs = measure_stubs(work / "stubs", arguments.shards)
    print(stubs, flush=True)
    wall = measure_nodes(work, settings, arguments.nodes)
    from uavmec_jax.training import host

    report = {"command": "uv run python experiments/ray_scale.py", "stubs": stubs, "study": wall, **host.describe()}
    write_report(arguments.out / "scale.json", report)


def measure_nodes(work: Path, settings: list[str], counts: list[int]) -> dict[str, Any]:
    """Measure the wall time of a study on some numbers of nodes, and simulate it."""
    last = {setting.partition("=")[0]: setting for setting in settings}  # a setting is given once
    options = [part for setting in last.values() for part in ("--set", setting)] + ["--shard-size", str(SHARD_SIZE)]
    alone = uavmec(["run", "table5", *options, "--out", str(work / "alone")], core=min(os.sched_getaffinity(0)))
    speed = read_run(work / "alone")["training_steps_per_second"]
    rows: list[dict[str, Any]] = [
        {"nodes": 0, "measured_s": alone, "simulated_s": simulated(options, speed, 1, ray=False)}
    ]
    for count in counts:
        cluster = SimulatedNodes(count, cpus=1, pinned=True)
        try:
            on_ray = ["--cpus-per-shard", "1", "--ray", cluster.address]
            measured = uavmec(["run", "table5", *options, "--out", str(work / f"nodes-{count}"), *on_ray])
        finally:
            cluster.shutdown()
        rows.append({"nodes": count, "measured_s": measured, "simulated_s": simulated(options, speed, count, ray=True)})
    for row in rows:
        row["error"] = round(row["simulated_s"] / row["measured_s"] - 1, 3)
        print(row, flush=True)
    return {"settings": settings, "shard_size": SHARD_SIZE, "speed_of_one_core": speed, "nodes": rows}


def uavmec(arguments: list[str], core: int | None = None) -> float:
    """Run a command, on one core if it is given, and return its wall time in seconds."""
    started = time.perf_counter()
    run_pinned(arguments, core)
    return round(time.perf_counter() - started, 1)


def run_pinned(arguments: list[str], core: int | None) -> str:
    """Run a command, on one core if it is given, and return what it prints."""
    command = [sys.executable, "-m", "uavmec_jax", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        if core is not None:
            psutil.Process(process.pid).cpu_affinity([core])  # before it has any threads
        printed, _ = process.communicate()
    if process.returncode != 0:
        raise subprocess.CalledProcessError(process.returncode, command)
    return printed


def simulated(options: list[str], speed: float, devices: int, *, ray: bool) -> float:
    """Return the wall time that `--simulate` estimates."""
    more = ["--simulate", "--speed", str(speed), "--devices", str(devices), "--json"]
    more += ["--cpus-per-shard", "1", "--ray"] if ray else []
    printed = run_pinned(["run", "table5", *options, *more], min(os.sched_getaffinity(0)))
    return round(float(json.loads(printed)["wall_s"]), 1)


def read_run(folder: Path) -> dict[str, Any]:
    """Return the label of a finished run."""
    return dict(json.loads((folder / "run.json").read_text()))


def write_nothing(directory: str, fingerprint: str, number: int, attempt: str, worker: Any) -> None:
    """Write an empty result, in place of an attempt at a shard."""
    folder = Path(directory) / "shards" / f"{number:05d}"
    folder.mkdir(parents=True)
    (folder / f"progress-{attempt}.json").write_text("{}")
    (folder / f"result-{attempt}.npz").touch()


def measure_stubs(folder: Path, shards: int) -> dict[str, Any]:
    """Measure a driver that has nothing but shards to schedule."""
    from uavmec_jax.runs import on_ray
    from uavmec_jax.runs.folder import RunFolder
    from uavmec_jax.runs.log import RunLog
    from uavmec_jax.runs.options import RunOptions
    from uavmec_jax.runs.run_plan import label_of, plan_run
    from uavmec_jax.runs.signals import StopSignal
    from uavmec_jax.runs.status import run_status
    from uavmec_jax.studies.study import load_study

    cluster = SimulatedNodes(4, cpus=1)
    study = load_study("table5", {"axes.seeds": max(shards // 25, 1), "steps": 1000})
    plan = plan_run(study, shard_size=1)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    run = RunFolder.create(folder, study, plan, RunOptions(), label_of(study, plan, "stubs"))
    on_ray.attempt_shard = write_nothing
    status_s: list[float] = []

    def on_progress(_: Any) -> None:
        if not status_s:  # once, in the middle of it
            status_s.append(seconds_of(lambda: run_status(folder)))

    log, memory = RunLog(folder / "log"), psutil.Process().memory_info().rss
    try:
        with connect(RayOptions(address=cluster.address, cpus_per_shard=1)) as connected, StopSignal() as stop:
            spent = seconds_of(lambda: on_ray.run_on_ray(run, connected, stop, log, on_progress))
            grown = psutil.Process().memory_info().rss - memory
    finally:
        log.close()
        cluster.shutdown()
    return {
        "shards": len(plan.shards),
        "seconds": round(spent, 1),
        "ms_per_shard": round(1000 * spent / len(plan.shards), 2),
        "driver_memory_mib": round(psutil.Process().memory_info().rss / 2**20),
        "driver_memory_grown_mib": round(grown / 2**20),
        "status_s": round(seconds_of(lambda: run_status(folder)), 2),
        "status_in_the_middle_s": round(status_s[0], 2) if status_s else None,
    }


def seconds_of(call: Any) -> float:
    """Return the wall time of a call."""
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


if __name__ == "__main__":
    main()

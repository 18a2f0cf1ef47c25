"""The estimates of `uavmec run --simulate` against a run: wall time, disk, memory.

    uv run python experiments/simulation_against_a_run.py --study table5 --set axes.seeds=3 --set steps=300000 --out runs/x

The run is a process of its own, which is watched: its duration, the largest size of its folder, and its largest memory. The
simulation gets the training speed that the run had. Prints a table and writes ``simulation.json``.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

import psutil
from reports import write_report

from uavmec_jax.cli.common import assignment
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.runs.run_plan import plan_run
from uavmec_jax.runs.simulate import simulate
from uavmec_jax.studies.study import load_study
from uavmec_jax.training import host


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--study", default="table5")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run")
    arguments = parser.parse_args()

    options = [part for setting in arguments.settings for part in ("--set", setting)]
    command = [sys.executable, "-m", "uavmec_jax", "run", arguments.study, *options, "--out", str(arguments.out)]
    measured = run_and_watch(command, arguments.out)

    host.use_all_cores()
    run = load_results(arguments.out).run
    study = load_study(arguments.study, dict(assignment(setting) for setting in arguments.settings))
    plan = plan_run(study)
    devices = max(partition.groups for partition in plan.partitions.values())
    speed = run.get("training_steps_per_second", 1) / devices
    simulated = simulate(study, plan, speed=speed, devices=devices).as_json()
    for name, value in measured.items():
        print(f"{name.replace('_', ' '):>14}: simulated {simulated[name]:>16,.0f}, measured {value:>16,.0f}")
    print(f"    wall time: {simulated['wall_s'] / measured['wall_s'] - 1:+.0%}")
    report = {"command": f"uavmec run {arguments.study} {' '.join(options)}", "speed_per_device": speed}
    report |= {"simulated": simulated, "measured": measured, "seconds": run["seconds"], **host.describe()}
    write_report(arguments.out / "simulation.json", report)


def run_and_watch(command: list[str], folder: Path) -> dict[str, float]:
    """Run a command; return its wall time, the largest size of the folder and the largest memory of the process."""
    started, disk, memory = time.perf_counter(), 0, 0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        watched = psutil.Process(process.pid)
        while process.poll() is None:
            try:
                memory = max(memory, watched.memory_info().rss)
                disk = max(disk, sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()))
            except (psutil.NoSuchProcess, FileNotFoundError):
                pass
            time.sleep(0.05)
    if process.returncode:
        sys.exit(process.returncode)
    return {"wall_s": time.perf_counter() - started, "disk_bytes": disk, "memory_bytes": memory}


if __name__ == "__main__":
    main()

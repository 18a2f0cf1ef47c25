"""What `uavmec run --simulate` says of a study beside what a run of it takes: wall time, disk, memory.

    uv run python experiments/simulation_against_a_run.py --study table5 --set axes.seeds=3 --set steps=300000

The run is a process of its own, watched from here: its folder's largest size, its largest memory, its time from start to
end. The simulation is given the training speed that the run then had. Prints a table, writes ``simulation.json``.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import psutil

from uavmec_jax.cli.common import assignment


def watched(command: list[str], folder: Path) -> dict[str, float]:
    """Run a command; its wall time, the folder's largest size and the process's largest memory."""
    started, disk, memory = time.perf_counter(), 0, 0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        seen = psutil.Process(process.pid)
        while process.poll() is None:
            try:
                memory = max(memory, seen.memory_info().rss)
                disk = max(disk, sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()))
            except (psutil.NoSuchProcess, FileNotFoundError):
                pass
            time.sleep(0.05)
    if process.returncode:
        sys.exit(process.returncode)
    return {"wall_s": time.perf_counter() - started, "disk_bytes": disk, "memory_bytes": memory}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--study", default="table5")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run")
    arguments = parser.parse_args()

    settings = [part for one in arguments.settings for part in ("--set", one)]
    command = [sys.executable, "-m", "uavmec_jax", "run", arguments.study, *settings, "--out", str(arguments.out)]
    measured = watched(command, arguments.out)

    from uavmec_jax.training import host

    host.use_all_cores()
    from uavmec_jax.files.writing import write_text
    from uavmec_jax.runs.results_folder import load_results
    from uavmec_jax.runs.run_plan import plan_run
    from uavmec_jax.runs.simulate import simulate
    from uavmec_jax.studies.study import load_study

    run = load_results(arguments.out).run
    study = load_study(arguments.study, dict(assignment(one) for one in arguments.settings))
    plan = plan_run(study)
    devices = max(cut.groups for cut in plan.blocks.values())
    speed = run.get("training_steps_per_second", 1) / devices
    said = simulate(study, plan, speed=speed, devices=devices).as_json()
    for name, value in measured.items():
        print(f"{name.replace('_', ' '):>14}: simulated {said[name]:>16,.0f}, measured {value:>16,.0f}")
    print(f"    wall time: {said['wall_s'] / measured['wall_s'] - 1:+.0%}")
    report = {"command": f"uavmec run {arguments.study} {' '.join(settings)}", "speed_per_device": speed}
    report |= {"simulated": said, "measured": measured, "seconds": run["seconds"], **host.describe()}
    write_text(arguments.out / "simulation.json", json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Table 5 with 30 seeds on an accelerator, and the speed of training and of the environment there.

    uv run --extra cuda python experiments/benchmark_accelerator.py --out results/gpu

Training is timed on filled replay buffers, as in `benchmark_dqn.py`. Prints a table and writes ``throughput.json``, with a
description of the machine; the run of Table 5 (750 agents x 1,000,000 steps) goes to ``table5`` and is resumed if the
script is started again. It also runs on a CPU, where ``--quick`` is a test of the script.
"""

import argparse
from pathlib import Path

from benchmark_dqn import train_speed
from reports import write_report

from uavmec_jax.reporting import canvas, figures
from uavmec_jax.runs.run import run_or_resume
from uavmec_jax.studies.study import load_study
from uavmec_jax.training import host
from uavmec_jax.training.environment_speed import environment_speed

POPULATIONS = (75, 750, 7500)
"""Numbers of agents that train together."""
LAYOUTS = (4096, 1_000_000)
"""Numbers of layouts that are played together with random actions."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each measurement")
    parser.add_argument("--quick", action="store_true", help="small sizes: a test of the script")
    arguments = parser.parse_args()
    host.use_all_cores()

    quick = arguments.quick
    report = {"command": "python experiments/benchmark_accelerator.py" + " --quick" * quick, **host.describe()}
    report["environment"] = []
    for layouts in (1000,) if quick else LAYOUTS:
        speed = environment_speed(layouts, arguments.seconds)
        report["environment"].append({"layouts": layouts, "steps_per_second": round(speed)})
        print(f"environment, {layouts:>9,} layouts: {speed:>14,.0f} steps/s", flush=True)
    report["training"] = []
    for agents in (2,) if quick else POPULATIONS:
        row = train_speed(agents, arguments.seconds)
        report["training"].append(row)
        print(f"training, {agents:>6,} agents: {row['steps_per_second']:>14,.0f} steps/s", flush=True)
    write_report(arguments.out / "throughput.json", report)

    heuristics_only = {"evaluation.planners": [], "evaluation.baselines": ["oldest-first"]}
    changes = {"axes.seeds": 1, "steps": 400} | heuristics_only if quick else {"axes.seeds": 30}
    directory = arguments.out / "table5"
    results = run_or_resume(load_study("table5", changes), directory, command="uavmec run table5 --seeds 30")
    canvas.save(figures.run_figure(results), directory / "figure.png")
    speed, seconds = results.run["training_steps_per_second"], results.run["seconds"]
    print(f"table5: {len(results.agents)} agents, {speed:,} steps/s, {seconds['wall']:,.0f} s in all")


if __name__ == "__main__":
    main()

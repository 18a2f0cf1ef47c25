"""Table 5 with 30 seeds on an accelerator, and how fast training and the environment are there.

    uv run --extra cuda python experiments/benchmark_accelerator.py --out results/gpu

Training is timed on filled replay memories, as in `benchmark_dqn.py`. Prints a table and writes ``throughput.json``, the
machine's description in it; the run of Table 5 (750 agents x 1,000,000 steps) goes to ``table5`` and is taken up again if
the script is started again. Runs on a CPU too, where ``--quick`` is a test of the script.
"""

import argparse
import json
from pathlib import Path

from benchmark_dqn import train_speed

TRAINED = (75, 750, 7500)
"""Agents that train together."""
PLAYED = 1_000_000
"""Layouts that are played together with random actions."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each measurement")
    parser.add_argument("--quick", action="store_true", help="small sizes: a test of the script")
    arguments = parser.parse_args()

    from uavmec_jax.training import host

    host.use_all_cores()
    from uavmec_jax.files.writing import write_text
    from uavmec_jax.reporting import canvas, figures
    from uavmec_jax.runs.run import run_or_resume
    from uavmec_jax.runs.speed import environment_speed
    from uavmec_jax.studies.study import load_study

    quick = arguments.quick
    report = {"command": "python experiments/benchmark_accelerator.py" + " --quick" * quick, **host.describe()}
    report["environment"] = []
    for layouts in (1000,) if quick else (4096, PLAYED):
        speed = environment_speed(layouts, arguments.seconds)
        report["environment"].append({"layouts": layouts, "steps_per_second": round(speed)})
        print(f"environment, {layouts:>9,} layouts: {speed:>14,.0f} steps/s", flush=True)
    report["training"] = []
    for agents in (2,) if quick else TRAINED:
        row = train_speed(agents, arguments.seconds)
        report["training"].append(row)
        print(f"training, {agents:>6,} agents: {row['steps_per_second']:>14,.0f} steps/s", flush=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_text(arguments.out / "throughput.json", json.dumps(report, indent=1) + "\n")

    heuristics = {"evaluation.planners": [], "evaluation.baselines": ["oldest-first"]}
    changes = {"axes.seeds": 1, "steps": 400} | heuristics if quick else {"axes.seeds": 30}
    directory = arguments.out / "table5"
    results = run_or_resume(load_study("table5", changes), directory, command="uavmec run table5 --seeds 30")
    canvas.save(figures.run_figure(results), directory / "figure.png")
    speed, seconds = results.run["training_steps_per_second"], results.run["seconds"]
    print(f"table5: {len(results.agents)} agents, {speed:,} steps/s, {seconds['wall']:,.0f} s in all")


if __name__ == "__main__":
    main()

"""The speed of the environment and of training on an accelerator, where the time goes there, and Table 5 with 30 seeds.

    uv run --extra cuda python experiments/benchmark_accelerator.py --out results/gpu

Training is timed on filled replay buffers, as in `benchmark_dqn.py`. Prints a table and writes ``throughput.json``, with a
description of the machine, after each part; the run of Table 5 (750 agents x 1,000,000 steps) goes to ``table5`` and is
resumed if the script is started again. It also runs on a CPU (``JAX_PLATFORMS=cpu``), where ``--quick`` is a test of the
script; the profile needs a GPU.
"""

import argparse
from pathlib import Path
from typing import Any

import jax
from benchmark_dqn import train_speed as dqn_speed
from benchmark_on_policy import train_speed as on_policy_speed
from device_profile import profile_training
from reports import write_report

from uavmec_jax.reporting import canvas, figures
from uavmec_jax.runs.run import run_or_resume
from uavmec_jax.studies.study import load_study
from uavmec_jax.training import host
from uavmec_jax.training.environment_speed import environment_speed

PARTS = ("environment", "fleet", "training", "rollouts", "profile", "table5")
"""What is measured, in this order."""
POPULATIONS = (75, 750, 7500)
"""Numbers of agents that train together."""
LAYOUTS = (4096, 1_000_000)
"""Numbers of layouts that are played together with random actions."""
FILLED = {75: 100_000, 750: 100_000, 7500: 12_000}
"""Transitions per agent in the replay buffers when the clock starts: what fits into the memory of one GPU."""


def measure_environment(quick: bool, seconds: float) -> list[dict]:
    """Measure random actions in many layouts."""
    rows = []
    for layouts in (1000,) if quick else LAYOUTS:
        rows.append({"layouts": layouts, "steps_per_second": round(environment_speed(layouts, seconds))})
        print(f"environment, {layouts:>9,} layouts: {rows[-1]['steps_per_second']:>14,} steps/s", flush=True)
    return rows


def measure_fleet(quick: bool, seconds: float) -> list[dict]:
    """Measure random actions of three UAVs with a depot."""
    rows = []
    for layouts in (100,) if quick else (4096, 131_072):
        speed = environment_speed(layouts, seconds, uavs=3, depot=True)
        rows.append({"layouts": layouts, "uavs": 3, "depot": True, "slots_per_second": round(speed)})
        print(f"three UAVs, {layouts:>10,} layouts: {round(speed):>14,} slots/s", flush=True)
    return rows


def measure_training(populations: tuple[int, ...], seconds: float) -> list[dict]:
    """Measure the DQN's training."""
    rows = []
    for agents in populations:
        rows.append(dqn_speed(agents, seconds, filled=FILLED.get(agents, 4_000)))
        print(f"dqn, {agents:>17,} agents: {rows[-1]['steps_per_second']:>14,.0f} steps/s", flush=True)
    return rows


def measure_rollouts(quick: bool, seconds: float) -> list[dict]:
    """Measure the training of PQN and PPO, with 64 environments per agent and 32 slots between updates."""
    rows = []
    for algorithm in ("pqn", "ppo"):
        for agents in (2,) if quick else (75, 750):
            rows.append(on_policy_speed(algorithm, agents, seconds, 64, {f"{algorithm}.n_steps": 32}))
            speed = rows[-1]["steps_per_second"]
            print(f"{algorithm}, {agents:>7,} agents x 64 environments: {speed:>12,.0f} steps/s", flush=True)
    return rows


def measure_table5(quick: bool, directory: Path) -> dict:
    """Run Table 5 with 30 seeds, or go on with it."""
    heuristics_only = {"evaluation.planners": [], "evaluation.baselines": ["oldest-first"]}
    changes = {"axes.seeds": 1, "steps": 400} | heuristics_only if quick else {"axes.seeds": 30}
    results = run_or_resume(load_study("table5", changes), directory, command="uavmec run table5 --seeds 30")
    canvas.save(figures.run_figure(results), directory / "figure.png")
    speed, seconds = results.run["training_steps_per_second"], results.run["seconds"]
    print(f"table5: {len(results.agents)} agents, {speed:,} steps/s, {seconds['wall']:,.0f} s in all")
    return {"agents": len(results.agents), "steps_per_second": speed, "seconds": seconds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each measurement")
    parser.add_argument(
        "--parts", nargs="+", choices=PARTS, default=PARTS, help="what to measure; by default all of it"
    )
    parser.add_argument("--agents", nargs="+", type=int, default=POPULATIONS, help="sizes of the DQN's populations")
    parser.add_argument("--quick", action="store_true", help="small sizes: a test of the script")
    arguments = parser.parse_args()
    host.use_all_cores()

    quick, seconds = arguments.quick, arguments.seconds
    report: dict[str, Any] = {
        "command": "python experiments/benchmark_accelerator.py" + " --quick" * quick,
        **host.describe(),
    }
    measures = {
        "environment": lambda: measure_environment(quick, seconds),
        "fleet": lambda: measure_fleet(quick, seconds),
        "training": lambda: measure_training((2,) if quick else tuple(arguments.agents), seconds),
        "rollouts": lambda: measure_rollouts(quick, seconds),
        "profile": lambda: None if jax.default_backend() == "cpu" else profile_training(),
        "table5": lambda: measure_table5(quick, arguments.out / "table5"),
    }
    for part in arguments.parts:
        report[part] = measures[part]()
        write_report(arguments.out / "throughput.json", report)


if __name__ == "__main__":
    main()

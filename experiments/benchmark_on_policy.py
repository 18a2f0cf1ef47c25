"""Training speed of PPO and A2C: this package and Stable-Baselines3 on the same environment, in one run.

    uv run --group sb3 python experiments/benchmark_on_policy.py --out results/benchmark

Both run with the library's defaults (PPO: 2,048 steps, ten epochs of minibatches of 64; A2C: 5 steps). Without the `sb3`
group the comparison is left out. Prints a table and writes ``benchmark_on_policy.json``.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reports import write_report

ALGORITHMS = ("ppo", "a2c")
POPULATIONS = (1, 8, 75, 300)
"""Numbers of agents that train together."""


def train_speed(
    algorithm: str, n_agents: int, seconds: float, n_envs: int = 1, changes: Mapping[str, Any] = {}
) -> dict:
    """Measure the environment steps/s of training with ``n_agents`` agents of ``n_envs`` environments each."""
    from training_speed import training_speed

    from uavmec_jax.studies.study import parse_study

    axes = f"[axes]\npowered = [8]\nconnected = [8]\nseeds = {n_agents}"
    study = parse_study(f"algorithm = '{algorithm}'\n{axes}", "benchmark", {f"{algorithm}.n_envs": n_envs, **changes})
    return {"algorithm": algorithm, "agents": n_agents, "n_envs": n_envs} | training_speed(study, seconds)


def sb3_worker(algorithm: str, seconds: float) -> None:
    """Measure the environment steps/s of one Stable-Baselines3 process, and print them."""
    os.environ["JAX_PLATFORMS"] = "cpu"
    import stable_baselines3
    import torch

    from uavmec_jax.interop.gymnasium_env import UavMecGymEnv

    torch.set_num_threads(1)  # faster than several for networks this small
    model = getattr(stable_baselines3, algorithm.upper())("MlpPolicy", UavMecGymEnv(), gamma=0.98, device="cpu", seed=0)
    model.learn(2048)
    started, steps = time.perf_counter(), model.num_timesteps
    while time.perf_counter() - started < seconds:
        model.learn(2048, reset_num_timesteps=False)
    print((model.num_timesteps - steps) / (time.perf_counter() - started))


def sb3_speed(algorithm: str, processes: int, seconds: float) -> float:
    """Measure the environment steps/s of several Stable-Baselines3 processes together."""
    command = [sys.executable, __file__, "--sb3-worker", algorithm, "--seconds", str(seconds)]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(processes)]
    return sum(float(process.communicate()[0].splitlines()[-1]) for process in running)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each measurement")
    parser.add_argument("--agents", type=int, nargs="+", default=POPULATIONS, help="sizes of the populations")
    parser.add_argument("--out", type=Path, help="folder for benchmark_on_policy.json")
    parser.add_argument("--sb3-worker", choices=ALGORITHMS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.sb3_worker:
        sb3_worker(arguments.sb3_worker, arguments.seconds)
        return
    from uavmec_jax.training import host

    host.use_all_cores()
    from importlib.util import find_spec

    from rich.console import Console
    from rich.table import Table

    facts = host.describe()
    has_sb3 = find_spec("stable_baselines3") is not None
    report: dict = {"command": " ".join(["python", *sys.argv]), **facts, "sb3": {}, "training": []}
    table = Table(title="Training, environment steps/s", title_justify="left")
    for column in ("what", "steps/s", "x one SB3 process", "compile s"):
        table.add_column(column, justify="left" if column == "what" else "right")
    for algorithm in ALGORITHMS:
        alone = sb3_speed(algorithm, 1, arguments.seconds) if has_sb3 else float("nan")
        together = sb3_speed(algorithm, facts["cores"], arguments.seconds) if has_sb3 else float("nan")
        report["sb3"][algorithm] = {"one_process": alone, "processes": facts["cores"], "all_processes": together}

        def ratio(speed: float, alone: float = alone) -> str:
            return f"{speed / alone:,.1f}" if has_sb3 else "-"

        if has_sb3:
            table.add_row(f"Stable-Baselines3 {algorithm.upper()}, one process", f"{alone:,.0f}", "1.0", "")
            table.add_row(f"Stable-Baselines3, {facts['cores']} processes", f"{together:,.0f}", ratio(together), "")
        for agents, n_envs in (*((n, 1) for n in arguments.agents), (8, 16)):
            row = train_speed(algorithm, agents, arguments.seconds, n_envs)
            report["training"].append(row)
            name = f"this package, {agents} agent{'s' * (agents > 1)}{f' x {n_envs} environments' * (n_envs > 1)}"
            speed = row["steps_per_second"]
            table.add_row(name, f"{speed:,.0f}", ratio(speed), f"{row['compile_seconds']:.1f}")
    Console(width=100).print(table)
    if arguments.out:
        write_report(arguments.out / "benchmark_on_policy.json", report)


if __name__ == "__main__":
    main()

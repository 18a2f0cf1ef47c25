"""Training speed: this package, Stable-Baselines3 on the same environment, and the arithmetic ceiling, in one run.

    uv run --group sb3 python experiments/benchmark_dqn.py --out results/benchmark

Both run the same algorithm (batches of 16, one gradient step per four environment steps), with replay buffers that hold
100,000 transitions per agent before the clock starts. Without the `sb3` group the comparison is left out. With
``--setting tuned`` both have batches of 64 and 10-step returns, and this package's DQN a double and dueling network besides,
which the library has not; the ceiling stays as it is. Prints a table and writes ``benchmark_dqn.json``.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from reports import write_report

FILLED = 100_000
"""Transitions per agent in the replay buffer when the clock starts."""
POPULATIONS = (1, 8, 75, 300)
"""Numbers of agents that train together."""
SETTINGS = {
    "paper": "",
    "tuned": "n_step = 10\ndouble = true\ndueling = true\nbatch_size = 64",
}
"""Settings of the DQN by name."""


def train_speed(n_agents: int, seconds: float, filled: int = FILLED, setting: str = "paper") -> dict:
    """Measure the environment steps/s of training with ``n_agents`` agents and ``filled`` transitions in each replay."""
    import jax
    import jax.numpy as jnp
    from training_speed import training_speed

    from uavmec_jax.studies.study import parse_study

    axes = f"[axes]\npowered = [8]\nconnected = [8]\nseeds = {n_agents}"
    study = parse_study(f"steps = {2 * filled}\n[dqn]\n{SETTINGS[setting]}\n{axes}", "benchmark")
    warm_up = 1000
    repeats = filled // warm_up // 4

    @partial(jax.jit, donate_argnums=0)
    def fill(rows: jax.Array) -> jax.Array:
        """Repeat the transitions of the warm-up."""
        return rows.at[:, 1 : filled + 1].set(jnp.tile(rows[:, 1 : 4 * warm_up + 1], (1, repeats, 1)))

    def prepare(state: Any) -> Any:
        return state.replace(buffer_state=fill(state.buffer_state))

    return {"agents": n_agents} | training_speed(study, seconds, warm_up=warm_up, start=filled // 4, prepare=prepare)


def ceiling(agents_per_device: int, seconds: float) -> float:
    """Measure the environment steps/s of a training that consists of its batched matrix products alone."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from jax.sharding import Mesh, PartitionSpec

    from uavmec_jax.agents.networks import matmul

    devices = jax.local_devices()
    mesh = Mesh(np.array(devices), ("agents",))
    shapes = ((24, 64), (64, 64), (64, 12))

    def products(_: int, carry: tuple) -> tuple:
        batch, observation, weights, target = carry
        for _ in range(4):  # acting
            q = observation
            for w in weights:
                q = q @ w
            observation = observation + 1e-9 * jnp.sum(q, keepdims=True)
        td_target = batch
        for w in target:  # forward pass of the target network
            td_target = td_target @ w

        def loss(weights: tuple) -> jax.Array:  # forward and backward pass
            q = batch
            for w in weights:
                q = matmul(q, w)
            return jnp.sum(q * td_target)

        gradient = jax.grad(loss)(weights)
        return batch, observation, jax.tree.map(lambda w, g: w - 1e-9 * g, weights, gradient), target

    def all_agents(carry: tuple, steps: int) -> tuple:
        return jax.vmap(lambda carry: jax.lax.fori_loop(0, steps, products, carry))(carry)

    n = agents_per_device * len(devices)
    weights = tuple(jax.random.normal(jax.random.key(i), (n, *shape)) * 0.1 for i, shape in enumerate(shapes))
    carry = (jnp.ones((n, 16, 24)), jnp.ones((n, 1, 24)), weights, tuple(w + 0 for w in weights))
    split = PartitionSpec("agents")
    in_specs = (split, PartitionSpec())
    run = jax.jit(jax.shard_map(all_agents, mesh=mesh, in_specs=in_specs, out_specs=split, check_vma=False))
    carry = jax.block_until_ready(run(carry, 200))
    rates, deadline = [], time.perf_counter() + seconds
    while time.perf_counter() < deadline:
        tick = time.perf_counter()
        carry = jax.block_until_ready(run(carry, 1000))
        rates.append(4 * 1000 * n / (time.perf_counter() - tick))
    return float(np.median(rates))


def sb3_worker(seconds: float, setting: str) -> None:
    """Measure the environment steps/s of one Stable-Baselines3 process, and print them as JSON."""
    os.environ["JAX_PLATFORMS"] = "cpu"
    import numpy as np
    import torch
    from stable_baselines3 import DQN

    from uavmec_jax.interop.gymnasium_env import UavMecGymEnv

    torch.set_num_threads(1)  # faster than several for networks this small
    nearest = {"batch_size": 64, "n_steps": 10} if setting == "tuned" else {"batch_size": 16}
    model = DQN(
        "MlpPolicy", UavMecGymEnv(), learning_rate=0.0071, gamma=0.98, **nearest,
        buffer_size=2 * FILLED, exploration_fraction=0.35, policy_kwargs={"net_arch": [64, 64]}, device="cpu", seed=0,
    )  # fmt: skip
    model.learn(2000)
    buffer = model.replay_buffer
    for array in (buffer.observations, buffer.next_observations, buffer.actions, buffer.rewards, buffer.dones):
        array[:FILLED] = np.tile(array[:2000], (FILLED // 2000,) + (1,) * (array.ndim - 1))
    buffer.pos = FILLED
    steps, spent = 0, 0.0
    while spent < seconds:
        tick = time.perf_counter()
        model.learn(1000, reset_num_timesteps=False)
        spent += time.perf_counter() - tick
        steps += 1000
    environment = model.get_env()
    environment.reset()
    tick = time.perf_counter()
    for action in range(2000):
        environment.step(np.array([action % 12]))
    share = (time.perf_counter() - tick) / 2000 * steps / spent
    print(json.dumps({"steps_per_second": steps / spent, "environment_share": share}))


def sb3_speed(processes: int, seconds: float, setting: str) -> tuple[float, float]:
    """Measure Stable-Baselines3 processes: environment steps/s of all together, and the environment's share of the time."""
    command = [sys.executable, __file__, "--sb3-worker", "--seconds", str(seconds), "--setting", setting]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(processes)]
    outputs = [process.communicate()[0] for process in running]
    rows = [json.loads(output.splitlines()[-1]) for output in outputs]
    return sum(row["steps_per_second"] for row in rows), max(row["environment_share"] for row in rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each measurement")
    parser.add_argument("--agents", type=int, nargs="+", default=POPULATIONS, help="sizes of the populations")
    parser.add_argument("--setting", choices=SETTINGS, default="paper", help="settings of the DQN")
    parser.add_argument("--out", type=Path, help="folder for benchmark_dqn.json")
    parser.add_argument("--sb3-worker", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.sb3_worker:
        sb3_worker(arguments.seconds, arguments.setting)
        return
    from uavmec_jax.training import host

    host.use_all_cores()
    from importlib.util import find_spec

    from rich.console import Console
    from rich.table import Table

    from uavmec_jax.training.environment_speed import environment_speed
    from uavmec_jax.training.partition import AGENTS_PER_CORE

    facts = host.describe()
    report = {"command": " ".join(["python", *sys.argv]), **facts, "filled_transitions_per_agent": FILLED}
    report["setting"] = arguments.setting
    has_sb3 = find_spec("stable_baselines3") is not None
    missing = (float("nan"), float("nan"))
    sb3_alone, share = sb3_speed(1, arguments.seconds, arguments.setting) if has_sb3 else missing
    report |= {"sb3_one_process": sb3_alone, "sb3_environment_share": share}
    cores = facts["cores"]
    report["sb3_processes"] = cores
    report["sb3_all_processes"], _ = sb3_speed(cores, arguments.seconds, arguments.setting) if has_sb3 else missing
    report["training"] = [train_speed(n, arguments.seconds, setting=arguments.setting) for n in arguments.agents]
    report["ceiling"] = ceiling(AGENTS_PER_CORE - 2, arguments.seconds)
    report["environment"] = {n: environment_speed(n, arguments.seconds) for n in (75, 4096)}

    table = Table(title="DQN training, environment steps/s", title_justify="left")
    for column in ("what", "steps/s", "x one SB3 process", "of the ceiling", "compile s"):
        table.add_column(column, justify="left" if column == "what" else "right")

    def ratio(speed: float) -> str:
        return f"{speed / sb3_alone:,.1f}" if has_sb3 else "-"

    if has_sb3:
        together = report["sb3_all_processes"]
        table.add_row(f"Stable-Baselines3, one process ({share:.0%} environment)", f"{sb3_alone:,.0f}", "1.0", "", "")
        table.add_row(f"Stable-Baselines3, {cores} processes", f"{together:,.0f}", ratio(together), "", "")
    for row in report["training"]:
        speed = row["steps_per_second"]
        name = f"this package, {row['agents']} agent{'s' * (row['agents'] > 1)}"
        ceiling_share = f"{speed / report['ceiling']:.0%}"
        table.add_row(name, f"{speed:,.0f}", ratio(speed), ceiling_share, f"{row['compile_seconds']:.1f}")
    name = f"matrix products of {len(facts['devices']) * (AGENTS_PER_CORE - 2)} agents alone"
    table.add_row(name, f"{report['ceiling']:,.0f}", ratio(report["ceiling"]), "100%", "")
    for n, speed in report["environment"].items():
        table.add_row(f"environment alone, {n} layouts", f"{speed:,.0f}", "", "", "")
    Console(width=100).print(table)
    if arguments.out:
        write_report(arguments.out / "benchmark_dqn.json", report)


if __name__ == "__main__":
    main()

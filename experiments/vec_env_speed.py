"""Stable-Baselines3 on this environment: one batched VecEnv beside one environment each, in this process and in others.

    uv run --group sb3 python experiments/vec_env_speed.py --out results/interop

Measures the slots per second of random actions, and of PPO with rollouts of 128 slots and batches of 256, in the same number
of environments. Each is timed in turn, `--rounds` times over, and the median is kept. Prints a table and writes
``vec_env_speed.json``.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import numpy as np
from reports import write_report
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from uavmec_jax.interop import UavMecGymEnv, UavMecSB3VecEnv
from uavmec_jax.training import host

KINDS: dict[str, Callable[[int], VecEnv]] = {
    "UavMecSB3VecEnv": UavMecSB3VecEnv,
    "DummyVecEnv": lambda n: DummyVecEnv([UavMecGymEnv] * n),
    "SubprocVecEnv": lambda n: SubprocVecEnv([UavMecGymEnv] * n),
}
MOST_PROCESSES = 8
"""Largest number of environments for which each has a process, which takes 300 MB."""


def slots_per_second(envs: VecEnv, seconds: float) -> float:
    """Play random actions for some seconds."""
    generator, steps = np.random.default_rng(0), 0
    envs.reset()
    envs.step(generator.integers(12, size=envs.num_envs))
    tick = time.perf_counter()
    while time.perf_counter() - tick < seconds:
        envs.step(generator.integers(12, size=envs.num_envs))
        steps += 1
    return steps * envs.num_envs / (time.perf_counter() - tick)


def trained_slots_per_second(envs: VecEnv, rollouts: int) -> float:
    """Train PPO for some rollouts, after one that is not timed."""
    model = PPO("MlpPolicy", envs, n_steps=128, batch_size=256, seed=0, device="cpu")
    per_rollout = 128 * envs.num_envs
    model.learn(per_rollout)
    tick = time.perf_counter()
    model.learn(rollouts * per_rollout)
    return rollouts * per_rollout / (time.perf_counter() - tick)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, nargs="+", default=[8, 32])
    parser.add_argument("--seconds", type=float, default=5.0, help="length of a measurement of random actions")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--rollouts", type=int, default=2, help="rollouts of PPO, of 128 slots in every environment")
    parser.add_argument("--out", type=Path, help="folder for vec_env_speed.json")
    arguments = parser.parse_args()
    rows = []
    for n in arguments.envs:
        made = {kind: make(n) for kind, make in KINDS.items() if kind != "SubprocVecEnv" or n <= MOST_PROCESSES}
        speeds: dict[str, list[tuple[float, float]]] = {kind: [] for kind in made}
        for _ in range(arguments.rounds):
            for kind, envs in made.items():
                random = slots_per_second(envs, arguments.seconds)
                speeds[kind].append((random, trained_slots_per_second(envs, arguments.rollouts)))
        for kind, envs in made.items():
            envs.close()
            random, trained = (statistics.median(column) for column in zip(*speeds[kind], strict=True))
            rows.append({"envs": n, "kind": kind, "random": round(random), "ppo": round(trained)})
            print(f"{n:>4} x {kind:<16} {random:>10,.0f} slots/s, PPO {trained:>8,.0f} slots/s", flush=True)
    report = {
        "command": " ".join(["python", *sys.argv]),
        "stable-baselines3": metadata.version("stable-baselines3"),
        "torch": metadata.version("torch"),
        **host.describe(),
        "slots_per_second": rows,
    }
    if arguments.out:
        write_report(arguments.out / "vec_env_speed.json", report)


if __name__ == "__main__":
    main()

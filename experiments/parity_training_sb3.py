"""Statistical parity: our DQN and Stable-Baselines3's on one layout, the same number of seeds and steps each.

    uv run --group sb3 python experiments/parity_training_sb3.py --out results/parity

Both learn with Table 4 on the layout of seed 0 with 8 powered and 8 connected devices; the greedy policies are then evaluated
on the same volume draws. Prints the mean lifetimes with 95 % intervals over the seeds; writes them to parity.json.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import Any

DRAWS = 64


def sb3_worker(seeds: list[int], steps: int) -> None:
    """Print the mean greedy lifetime of each seed, learned by Stable-Baselines3."""
    os.environ["JAX_PLATFORMS"] = "cpu"
    import jax
    import numpy as np
    import torch
    from stable_baselines3 import DQN

    from uavmec_jax.env.dynamics import Cause, initial_state, transition
    from uavmec_jax.env.observation import observe
    from uavmec_jax.env.rollout import volume_table
    from uavmec_jax.env.scenario import make_scenario
    from uavmec_jax.interop.gymnasium_env import UavMecGymEnv

    torch.set_num_threads(1)
    scenario = make_scenario(layout())
    params, devices = scenario.params, scenario.layout
    volumes = np.asarray(jax.vmap(lambda key: volume_table(params, 12, key, 64))(draws()))
    start = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (DRAWS, *np.shape(leaf))), initial_state(params, devices))
    step = jax.jit(jax.vmap(lambda state, action, drawn: transition(params, devices, state, action, drawn)))
    for seed in seeds:
        model = DQN(
            "MlpPolicy", UavMecGymEnv(scenario), learning_rate=0.0071, batch_size=16, gamma=0.98, buffer_size=steps,
            exploration_fraction=0.35, policy_kwargs={"net_arch": [64, 64]}, device="cpu", seed=seed,
        )  # fmt: skip
        model.learn(steps)
        state, length = start, np.zeros(DRAWS, int)
        for slot in range(64):
            seen = np.asarray(jax.vmap(observe, (None, None, 0))(params, devices, state))
            after, outcome = step(state, model.predict(seen, deterministic=True)[0], volumes[:, slot])
            length = np.where(length > 0, length, np.where(np.asarray(outcome.cause) != Cause.NONE, slot + 1, 0))
            state = after
        assert (length > 0).all()
        print(json.dumps({"seed": seed, "lifetime": float(length.mean())}), flush=True)


def layout() -> Any:
    """The one layout: what studies call seed 0 with 8 powered and 8 connected devices."""
    from uavmec_jax.env.params import Params
    from uavmec_jax.scenarios.seeds import layout_for_seed

    return layout_for_seed(0, Params(), 8, 8)


def draws() -> Any:
    """The volume draws on which both are evaluated."""
    from uavmec_jax.scenarios.seeds import held_out_draws

    return held_out_draws(0, 8, 8, DRAWS)


def ours(seeds: int, steps: int) -> list[float]:
    """Mean greedy lifetime of each seed, learned by this package as one program."""
    import jax
    import jax.numpy as jnp

    from uavmec_jax.agents import dqn
    from uavmec_jax.agents.algorithm import Agent
    from uavmec_jax.env.rollout import rollouts
    from uavmec_jax.env.scenario import make_scenario
    from uavmec_jax.training import host
    from uavmec_jax.training.partition import partition_population
    from uavmec_jax.training.population import train_population
    from uavmec_jax.training.training import Validation

    host.use_all_cores()
    algorithm = dqn.algorithm(dqn.DQNSpec(total_steps=steps))
    alone = Agent(key=jax.random.key(0), scenario=make_scenario(layout()), hyper=dqn.DQNHyper())
    agents = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (seeds, *jnp.shape(leaf))), alone)
    agents = agents.replace(key=jax.random.split(jax.random.key(1), seeds))
    partition = partition_population(seeds, algorithm.agent_bytes, host.free_memory())
    keys = jax.random.split(jax.random.key(2), (seeds, 1))
    lifetimes: list[float] = []
    params, devices, validation = alone.scenario.params, alone.scenario.layout, Validation(every=steps, draws=1)

    def mean_lifetime(weights: Any) -> Any:
        return rollouts(algorithm.policy(dqn.DQNHyper(), weights), params, devices, draws()).length.mean()

    for shard in train_population(algorithm, agents, keys, validation=validation, partition=partition):
        lifetimes += jax.jit(jax.vmap(mean_lifetime))(shard.last).tolist()
    return lifetimes


def theirs(seeds: int, steps: int, processes: int) -> list[float]:
    """The same by Stable-Baselines3, the seeds dealt out to processes."""
    running = []
    for worker in range(processes):
        own = [str(seed) for seed in range(worker, seeds, processes)]
        command = [sys.executable, __file__, "--sb3-worker", *own, "--steps", str(steps)]
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
    lines = [line for process in running for line in process.communicate()[0].splitlines()]
    found = {row["seed"]: row["lifetime"] for row in map(json.loads, lines)}
    return [found[seed] for seed in range(seeds)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="of Stable-Baselines3")
    parser.add_argument("--out", type=Path, help="folder for parity.json")
    parser.add_argument("--sb3-worker", type=int, nargs="+", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.sb3_worker is not None:
        sb3_worker(arguments.sb3_worker, arguments.steps)
        return
    import numpy as np

    report: dict = {"command": " ".join(["python", *sys.argv]), "seeds": arguments.seeds, "steps": arguments.steps}
    report["versions"] = {name: metadata.version(name) for name in ("uavmec-jax", "stable-baselines3", "torch", "jax")}
    intervals = []
    for name, play in (("stable_baselines3", lambda *a: theirs(*a, arguments.processes)), ("uavmec_jax", ours)):
        tick = time.perf_counter()
        lifetimes = play(arguments.seeds, arguments.steps)
        seconds = time.perf_counter() - tick
        from uavmec_jax.studies.statistics import mean_interval

        mean, low, high = mean_interval(np.array(lifetimes))
        intervals.append((low, high))
        report[name] = {"mean": mean, "low": low, "high": high, "lifetimes": lifetimes, "seconds": round(seconds, 1)}
        print(f"{name}: {mean:.2f} slots, 95 % {low:.2f} to {high:.2f}, {seconds:.0f} s: {np.round(lifetimes, 2)}")
    (low_a, high_a), (low_b, high_b) = intervals
    report["intervals_overlap"] = bool(low_a <= high_b and low_b <= high_a)
    print(f"the intervals {'overlap' if report['intervals_overlap'] else 'do not overlap'}")
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        (arguments.out / "parity.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

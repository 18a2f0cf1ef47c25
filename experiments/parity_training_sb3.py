"""Statistical parity: our DQN and that of Stable-Baselines3 on one layout, with as many seeds and steps each.

    uv run --group sb3 python experiments/parity_training_sb3.py --out results/parity

Both train with the settings of Table 4 on the layout of seed 0 with 8 powered and 8 connected devices; then their greedy
policies are evaluated on the same volume draws. Prints the mean lifetimes with 95 % intervals over the seeds, and writes them
to parity.json.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

from reports import write_report
from sb3_quality import lifetimes_of

DRAWS = 64
"""Volume draws of the evaluation."""


def sb3_worker(seeds: list[int], steps: int) -> None:
    """Train with Stable-Baselines3, and print the mean lifetime of each seed's greedy policy."""
    os.environ["JAX_PLATFORMS"] = "cpu"
    import torch
    from stable_baselines3 import DQN

    from uavmec_jax.env.scenario import make_scenario
    from uavmec_jax.interop.gymnasium_env import UavMecGymEnv

    torch.set_num_threads(1)
    scenario = make_scenario(make_layout())
    for seed in seeds:
        model = DQN(
            "MlpPolicy", UavMecGymEnv(scenario), learning_rate=0.0071, batch_size=16, gamma=0.98, buffer_size=steps,
            exploration_fraction=0.35, policy_kwargs={"net_arch": [64, 64]}, device="cpu", seed=seed,
        )  # fmt: skip
        model.learn(steps)
        lifetime = float(lifetimes_of(model, scenario, evaluation_draws()).mean())
        print(json.dumps({"seed": seed, "lifetime": lifetime}), flush=True)


def make_layout() -> Any:
    """Return the layout that studies have for seed 0 with 8 powered and 8 connected devices."""
    from uavmec_jax.env.params import Params
    from uavmec_jax.scenarios.seeds import layout_for_seed

    return layout_for_seed(0, Params(), 8, 8)


def evaluation_draws() -> Any:
    """Return the volume draws of the evaluation."""
    from uavmec_jax.scenarios.seeds import held_out_draws

    return held_out_draws(0, 8, 8, DRAWS)


def ours(seeds: int, steps: int) -> list[float]:
    """Train with this package, all seeds as one population, and return the mean lifetime of each greedy policy."""
    import jax
    import jax.numpy as jnp

    from uavmec_jax.agents import dqn
    from uavmec_jax.agents.algorithm import Agent
    from uavmec_jax.env.rollout import rollouts
    from uavmec_jax.env.scenario import make_scenario
    from uavmec_jax.training import host
    from uavmec_jax.training.chunks import Validation
    from uavmec_jax.training.partition import partition_population
    from uavmec_jax.training.population import train_population

    host.use_all_cores()
    algorithm, hyper = dqn.algorithm(dqn.DQNSpec(total_steps=steps)), dqn.DQNHyper()
    scenario = make_scenario(make_layout())
    agent = Agent(key=jax.random.key(0), scenario=scenario, hyper=hyper)
    agents = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (seeds, *jnp.shape(leaf))), agent)
    agents = agents.replace(key=jax.random.split(jax.random.key(1), seeds))
    keys = jax.random.split(jax.random.key(2), (seeds, 1))
    partition = partition_population(seeds, algorithm.agent_bytes, host.free_memory())
    validation = Validation(every=steps, draws=1)

    @jax.jit
    @jax.vmap
    def mean_lifetime(weights: Any) -> jax.Array:
        policy = algorithm.policy(hyper, weights)
        return rollouts(policy, scenario.params, scenario.layout, evaluation_draws()).length.mean()

    shards = train_population(algorithm, agents, keys, validation=validation, partition=partition)
    return [lifetime for shard in shards for lifetime in mean_lifetime(shard.last).tolist()]


def theirs(seeds: int, steps: int, processes: int) -> list[float]:
    """Train with Stable-Baselines3, the seeds spread over processes, and return the mean lifetime of each greedy policy."""
    running = []
    for worker in range(processes):
        chosen = [str(seed) for seed in range(worker, seeds, processes)]
        command = [sys.executable, __file__, "--sb3-worker", *chosen, "--steps", str(steps)]
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
    lines = [line for process in running for line in process.communicate()[0].splitlines()]
    lifetimes = {row["seed"]: row["lifetime"] for row in map(json.loads, lines)}
    return [lifetimes[seed] for seed in range(seeds)]


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
    for name, train in (("stable_baselines3", partial(theirs, processes=arguments.processes)), ("uavmec_jax", ours)):
        tick = time.perf_counter()
        lifetimes = train(arguments.seeds, arguments.steps)
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
        write_report(arguments.out / "parity.json", report)


if __name__ == "__main__":
    main()

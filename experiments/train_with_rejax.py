"""An algorithm of another library on this environment: PPO of rejax, through the five-value adapter.

    uv run --no-default-groups --group rejax python experiments/train_with_rejax.py --out results/rejax

Trains on one layout with 8 powered and 8 connected devices and prints the greedy policy's lifetime beside oldest-first's.
rejax (https://github.com/keraJLi/rejax) expects the step of gymnax 0.0.9, which FiveValueEnv has.
"""

import argparse
import json
import sys
import time
from importlib import metadata
from pathlib import Path

import jax
import rejax
from rejax.evaluate import evaluate
from reports import write_report

from uavmec_jax.env.rollout import rollouts
from uavmec_jax.env.scenario import make_scenario
from uavmec_jax.interop.five_values import FiveValueEnv, FiveValueParams
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.training import host


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=500_000)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--out", type=Path, help="folder for rejax.json")
    arguments = parser.parse_args()
    scenario = make_scenario()
    env, params = FiveValueEnv(), FiveValueParams(scenario=scenario)
    algorithm = rejax.get_algo("ppo").create(
        env=env, env_params=params, total_timesteps=arguments.steps, eval_freq=arguments.steps, gamma=0.98,
        learning_rate=3e-4, num_envs=16, num_steps=128, num_epochs=10, num_minibatches=32, gae_lambda=0.95,
        clip_eps=0.2, ent_coef=0.0, vf_coef=0.5, max_grad_norm=0.5, skip_initial_evaluation=True,
        agent_kwargs={"activation": "tanh"},
    )  # fmt: skip
    tick = time.perf_counter()
    keys = jax.random.split(jax.random.key(0), arguments.seeds)
    state, _ = jax.block_until_ready(jax.jit(jax.vmap(algorithm.train))(keys))
    seconds = time.perf_counter() - tick
    lifetimes = []
    for seed in range(arguments.seeds):
        act = algorithm.make_act(jax.tree.map(lambda leaf, seed=seed: leaf[seed], state))
        lengths, _ = evaluate(act, jax.random.key(1), env, params, 64, params.max_steps_in_episode)
        lifetimes.append(float(lengths.mean()))
    draws = jax.random.split(jax.random.key(1), 64)
    oldest_first = rollouts(HEURISTICS["oldest-first"], scenario.params, scenario.layout, draws).length.mean()
    report = {
        "command": " ".join(["python", *sys.argv]),
        "rejax": metadata.version("rejax"),
        **host.describe(),
        "steps": arguments.steps,
        "seconds_with_compilation": round(seconds, 1),
        "lifetime_slots_of_each_seed": lifetimes,
        "oldest_first_slots": float(oldest_first),
    }
    print(json.dumps(report, indent=1))
    if arguments.out:
        write_report(arguments.out / "rejax.json", report)


if __name__ == "__main__":
    main()

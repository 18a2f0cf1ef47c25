"""The generalist inside the planners: as the base policy of the rollout planner, and its critic as the beam's score.

    uv run python experiments/generalist_planners.py [--layouts 8] [--out results/generalist]

The rollout planner simulates futures in which a base policy decides: `earliest-deadline` or the generalist. The beam keeps
the states with the best score: its own, or the value that the generalist's critic gives them. All play the same volumes of
the study `planning`, so differences are paired. Writes `planners.json`.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from reports import write_report

from uavmec_jax.planning.fleet_demand import planned_slots
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.parallel import beam_episodes, policy_episodes, rollout_planner_episodes
from uavmec_jax.planning.rollout_planner import SAMPLES
from uavmec_jax.scenarios.policies import TrainedPolicy, load_policy
from uavmec_jax.studies.population import evaluation_keys, make_agents
from uavmec_jax.studies.statistics import mean_interval
from uavmec_jax.studies.study import load_study
from uavmec_jax.training import host


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="generalist")
    parser.add_argument("--layouts", type=int, default=8, help="in each of the 25 cells")
    parser.add_argument("--widths", type=int, nargs="+", default=[4, 16, 64])
    parser.add_argument("--out", type=Path, default=Path("results/generalist"))
    arguments = parser.parse_args()
    host.use_all_cores()

    policy = load_policy(arguments.policy)
    assert isinstance(policy, TrainedPolicy)
    study = load_study("planning", {"axes.seeds": arguments.layouts})
    scenario, keys = make_agents(study).scenario, evaluation_keys(study)[:, 0]
    scenarios = (scenario.params, scenario.layout)
    slots = planned_slots(*scenarios)

    lifetimes: dict[str, np.ndarray] = {}
    seconds: dict[str, float] = {}

    def measure(name: str, play: Callable[[], Any]) -> None:
        jax.block_until_ready(play())  # compiles
        tick = time.perf_counter()
        lifetimes[name] = np.asarray(jax.block_until_ready(play()).length).reshape(-1)
        seconds[name] = round(time.perf_counter() - tick, 2)

    policies = {"earliest-deadline": HEURISTICS["earliest-deadline"], "generalist": policy}
    for name, base in policies.items():
        measure(name, lambda base=base: policy_episodes(base, *scenarios, keys[:, None]))
    for name, base in policies.items():
        settings = {"slots": slots, "samples": SAMPLES, "base": base}
        measure(
            f"rollout, base {name}", lambda options=settings: rollout_planner_episodes(*scenarios, keys, **options)[1]
        )
    for width in arguments.widths:
        for name, value_fn in (("own score", None), ("generalist's critic", policy.value)):
            settings = {"slots": slots, "width": width, "value_fn": value_fn}
            measure(f"beam {width}, {name}", lambda options=settings: beam_episodes(*scenarios, keys, **options)[1])

    pairs = [("generalist", "earliest-deadline"), ("rollout, base generalist", "rollout, base earliest-deadline")]
    pairs += [("rollout, base generalist", "generalist")]
    pairs += [(f"beam {width}, generalist's critic", f"beam {width}, own score") for width in arguments.widths]
    differences = {f"{a} - {b}": mean_interval(lifetimes[a] - lifetimes[b]) for a, b in pairs}
    report = {
        "command": "uv run python experiments/generalist_planners.py",
        "episodes": len(keys),
        "mean_slots": {name: round(float(lifetime.mean()), 3) for name, lifetime in lifetimes.items()},
        "seconds": seconds,
        "differences": {name: [round(x, 3) for x in interval] for name, interval in differences.items()},
        **host.describe(),
    }
    write_report(arguments.out / "planners.json", report)
    print(json.dumps({name: report[name] for name in ("mean_slots", "seconds", "differences")}, indent=1))


if __name__ == "__main__":
    main()

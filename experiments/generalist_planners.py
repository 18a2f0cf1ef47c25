"""Does the generalist lift the planners? As the base of the rollout planner, and as the beam's pruning score.

    uv run python experiments/generalist_planners.py [--towns 8] [--out results/generalist]

The rollout planner imagines how a policy would go on: `earliest-deadline` or the generalist. The beam keeps the states
from which the aim takes the least, or those that the generalist's critic values most. All play the same volumes of the
study `planning`, so differences are paired. Writes `planners.json`.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from uavmec_jax.training import host

host.use_all_cores()

import jax  # noqa: E402
import numpy as np  # noqa: E402

from uavmec_jax.planning.beam import horizon
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.parallel import beam_episodes, policy_episodes, rollout_planner_episodes
from uavmec_jax.planning.rollout_planner import SAMPLES
from uavmec_jax.scenarios.policies import TrainedPolicy, load_policy
from uavmec_jax.studies.population import evaluation_keys, make_agents
from uavmec_jax.studies.statistics import mean_interval
from uavmec_jax.studies.study import load_study


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="generalist")
    parser.add_argument("--towns", type=int, default=8, help="in each of the 25 cells")
    parser.add_argument("--widths", type=int, nargs="+", default=[4, 16, 64])
    parser.add_argument("--out", type=Path, default=Path("results/generalist"))
    arguments = parser.parse_args()

    policy = load_policy(arguments.policy)
    assert isinstance(policy, TrainedPolicy)
    rule = HEURISTICS["earliest-deadline"]
    study = load_study("planning", {"axes.seeds": arguments.towns})
    scenario, keys = make_agents(study).scenario, evaluation_keys(study)[:, 0]
    towns = (scenario.params, scenario.layout)
    slots = horizon(*towns)

    lives: dict[str, np.ndarray] = {}
    seconds: dict[str, float] = {}

    def measure(name: str, play: Callable[[], Any]) -> None:
        jax.block_until_ready(play())  # compiled here
        tick = time.perf_counter()
        lives[name] = np.asarray(jax.block_until_ready(play()).length).reshape(-1)
        seconds[name] = round(time.perf_counter() - tick, 2)

    for name, one in (("earliest-deadline", rule), ("generalist", policy)):
        measure(name, lambda one=one: policy_episodes(one, *towns, keys[:, None]))
    for name, base in (("earliest-deadline", rule), ("generalist", policy)):
        measure(
            f"rollout, base {name}",
            lambda base=base: rollout_planner_episodes(*towns, keys, slots=slots, samples=SAMPLES, base=base)[1],
        )
    for width in arguments.widths:
        for name, value_fn in (("own score", None), ("generalist's critic", policy.value_fn)):
            measure(
                f"beam {width}, {name}",
                lambda width=width, value_fn=value_fn: beam_episodes(
                    *towns, keys, slots=slots, width=width, value_fn=value_fn
                )[1],
            )

    pairs = [("generalist", "earliest-deadline"), ("rollout, base generalist", "rollout, base earliest-deadline")]
    pairs += [("rollout, base generalist", "generalist")]
    pairs += [(f"beam {width}, generalist's critic", f"beam {width}, own score") for width in arguments.widths]
    report = {
        "command": "uv run python experiments/generalist_planners.py",
        "episodes": len(keys),
        "mean_slots": {name: round(float(life.mean()), 3) for name, life in lives.items()},
        "seconds": seconds,
        "differences": {f"{a} - {b}": [round(x, 3) for x in mean_interval(lives[a] - lives[b])] for a, b in pairs},
        **host.describe(),
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "planners.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print(json.dumps({name: report[name] for name in ("mean_slots", "seconds", "differences")}, indent=1))


if __name__ == "__main__":
    main()

"""How fast the generalist decides: one decision after compilation, and many at once, each in a scenario of its own.

    uv run python experiments/generalist_speed.py [--scenarios 8192] [--out results/generalist]

Writes `speed.json`: the median of the times of single decisions, and decisions per second in a batch on all cores, the best
and the median of the repetitions (the machine is shared).
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

from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.parallel import spread
from uavmec_jax.scenarios.policies import load_policy

_BATCH = 256
"""Scenarios that a core decides for at once."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="generalist")
    parser.add_argument("--scenarios", type=int, default=8192)
    parser.add_argument("--repetitions", type=int, default=21)
    parser.add_argument("--out", type=Path, default=Path("results/generalist"))
    arguments = parser.parse_args()

    params, count = Params(), arguments.scenarios
    layouts = jax.vmap(lambda key: sample_layout(key, params, 8, 8))(jax.random.split(jax.random.key(0), count))
    states = jax.vmap(lambda layout: initial_state(params, layout))(layouts)
    first = jax.tree.map(lambda leaf: leaf[0], (layouts, states))
    rows = {}
    for name in (arguments.policy, "earliest-deadline"):
        policy = load_policy(name) if name not in HEURISTICS else HEURISTICS[name]
        decide = lambda layout, state, policy=policy: policy(params, layout, state)  # noqa: E731
        one = measure(jax.jit(decide), first, 10 * arguments.repetitions)
        many = measure(
            jax.jit(lambda *those, decide=decide: spread(decide, *those, batch=_BATCH)),
            (layouts, states),
            arguments.repetitions,
        )
        rows[name] = {
            "one_decision_us": round(1e6 * float(np.median(one)), 1),
            "decisions_per_second": round(count / float(np.median(many))),
            "decisions_per_second_best": round(count / min(many)),
        }
    report = {"command": "uv run python experiments/generalist_speed.py", "scenarios": count, "policies": rows}
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "speed.json").write_text(json.dumps(report | host.describe(), indent=1) + "\n", encoding="utf-8")
    print(json.dumps(rows, indent=1))


def measure(function: Callable, arguments: tuple[Any, ...], repetitions: int) -> list[float]:
    """Seconds of every call after the first."""
    jax.block_until_ready(function(*arguments))
    found = []
    for _ in range(repetitions):
        tick = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        found.append(time.perf_counter() - tick)
    return found


if __name__ == "__main__":
    main()

"""The generalist's speed: one decision after compilation, and a batch of decisions in as many scenarios.

    uv run python experiments/generalist_speed.py [--scenarios 8192] [--out results/generalist]

Writes `speed.json`: the median time of single decisions, and decisions per second in a batch on all cores, the best and the
median of the repetitions.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array
from reports import write_report

from uavmec_jax.env.dynamics import State, initial_state
from uavmec_jax.env.layout import Layout, sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy
from uavmec_jax.planning.parallel import spread
from uavmec_jax.scenarios.policies import load_policy
from uavmec_jax.training import host

_BATCH = 256
"""Scenarios that a core decides for at once."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="generalist")
    parser.add_argument("--scenarios", type=int, default=8192)
    parser.add_argument("--repetitions", type=int, default=21)
    parser.add_argument("--out", type=Path, default=Path("results/generalist"))
    arguments = parser.parse_args()
    host.use_all_cores()

    params, count = Params(), arguments.scenarios
    layouts = jax.vmap(lambda key: sample_layout(key, params, 8, 8))(jax.random.split(jax.random.key(0), count))
    states = jax.vmap(lambda layout: initial_state(params, layout))(layouts)
    rows = {
        name: measure(load_policy(name), params, layouts, states, arguments.repetitions)
        for name in (arguments.policy, "earliest-deadline")
    }
    report = {"command": "uv run python experiments/generalist_speed.py", "scenarios": count, "policies": rows}
    write_report(arguments.out / "speed.json", report | host.describe())
    print(json.dumps(rows, indent=1))


def measure(policy: Policy, params: Params, layouts: Layout, states: State, repetitions: int) -> dict[str, float]:
    """Time a policy on the first scenario, and on all of them."""

    def decide(layout: Layout, state: State) -> Array:
        return policy(params, layout, state)

    def decide_all(layouts: Layout, states: State) -> Array:
        return spread(decide, layouts, states, batch=_BATCH)

    first = jax.tree.map(lambda leaf: leaf[0], (layouts, states))
    single = time_calls(jax.jit(decide), first, 10 * repetitions)
    batch, count = time_calls(jax.jit(decide_all), (layouts, states), repetitions), layouts.capacity.shape[0]
    return {
        "one_decision_us": round(1e6 * float(np.median(single)), 1),
        "decisions_per_second": round(count / float(np.median(batch))),
        "decisions_per_second_best": round(count / min(batch)),
    }


def time_calls(function: Callable, arguments: tuple[Any, ...], repetitions: int) -> list[float]:
    """Return the seconds of every call after the first, which compiles."""
    jax.block_until_ready(function(*arguments))
    seconds = []
    for _ in range(repetitions):
        tick = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        seconds.append(time.perf_counter() - tick)
    return seconds


if __name__ == "__main__":
    main()

"""Speed of the planners, and the lifetimes that a wider beam reaches, on 100 layouts per cell.

    uv run python experiments/benchmark_planning.py [--layouts 100] [--widths 16 64 256] [--out results/planning]

Prints a table and writes ``benchmark_planning.json``; times are those of the first call, with compilation, and of the second.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from reports import write_report

from uavmec_jax.env.params import Params
from uavmec_jax.planning.fleet_demand import planned_slots
from uavmec_jax.planning.parallel import beam_episodes, bound_scenarios, rollout_planner_episodes
from uavmec_jax.planning.rollout_planner import SAMPLES
from uavmec_jax.scenarios.seeds import held_out_draws, layout_for_seed
from uavmec_jax.training import host

CELLS = [(12, 4), (10, 10), (8, 8), (4, 4)]
"""Counts of powered and connected devices."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layouts", type=int, default=100)
    parser.add_argument("--widths", type=int, nargs="+", default=[256, 64, 16])
    parser.add_argument("--out", type=Path, default=Path("results/planning"))
    arguments = parser.parse_args()
    host.use_all_cores()

    rows = [row for cell in CELLS for row in benchmark(*cell, arguments.layouts, arguments.widths)]
    report = {"command": "uv run python experiments/benchmark_planning.py", "rows": rows, **host.describe()}
    write_report(arguments.out / "benchmark_planning.json", report)
    print(f"{'powered':>8}{'connected':>10}  {'planner':<10}{'mean slots':>11}{'s, compiled':>13}{'s, first':>10}")
    for row in rows:
        print(
            f"{row['powered']:>8}{row['connected']:>10}  {row['planner']:<10}{row['mean']:>11.2f}"
            f"{row['seconds_compiled']:>13.1f}{row['seconds_first']:>10.1f}"
        )


def benchmark(powered: int, connected: int, count: int, widths: list[int]) -> list[dict[str, Any]]:
    """Return a row per planner: mean lifetime, seconds of the first call (with compilation) and of the second."""
    params = jax.tree.map(lambda leaf: jnp.full(count, leaf), Params())
    layouts = jax.vmap(lambda seed: layout_for_seed(seed, Params(), powered, connected))(jnp.arange(count))
    keys = jnp.concatenate([held_out_draws(seed, powered, connected, 1) for seed in range(count)])
    scenarios = (params, layouts, keys)
    slots = planned_slots(params, layouts)
    rows, reached = [], np.ones(count)

    def measure(planner: str, function: Callable, *arguments: Any, **options: Any) -> np.ndarray:
        jax.clear_caches()  # the first call takes what it takes in a new process
        result, first = timed(function, *arguments, **options)
        _, second = timed(function, *arguments, **options)
        lifetimes = np.asarray(result[1].length if isinstance(result, tuple) else result)
        cell = {"powered": powered, "connected": connected, "layouts": count, "planner": planner}
        rows.append(cell | {"mean": float(lifetimes.mean()), "seconds_first": first, "seconds_compiled": second})
        return lifetimes

    for width in widths:
        reached = np.maximum(reached, measure(f"beam {width}", beam_episodes, *scenarios, slots=slots, width=width))
    measure("rollout", rollout_planner_episodes, *scenarios, slots=slots, samples=SAMPLES)
    measure("bound", bound_scenarios, *scenarios, reached, slots=slots)
    return rows


def timed(function: Callable, *arguments: Any, **options: Any) -> tuple[Any, float]:
    """Call a function; return its result and the seconds that it took."""
    tick = time.perf_counter()
    result = jax.block_until_ready(function(*arguments, **options))
    return result, time.perf_counter() - tick


if __name__ == "__main__":
    main()

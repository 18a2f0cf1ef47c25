"""Speed and memory of fleets: the environment from 2 to 1,000 devices, and one decision of rules and of the rollout planner.

    uv run python experiments/benchmark_fleet.py [--seconds 3] [--out results/fleet]

Prints tables and writes ``benchmark_fleet.json``.
"""

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

import jax
from reports import write_report

from uavmec_jax.env.dynamics import State, initial_state
from uavmec_jax.env.fleet import make_depots, make_fleet
from uavmec_jax.env.layout import Layout, sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import Policy
from uavmec_jax.planning.fleet_deadlines import earliest_deadline, split_deadline
from uavmec_jax.planning.rollout_planner import rollout_planner
from uavmec_jax.training import host
from uavmec_jax.training.environment_speed import environment_speed

ENVIRONMENTS = [
    (1, 12, 4096, False),
    (1, 12, 75, False),
    (2, 12, 4096, True),
    (3, 12, 4096, False),
    (3, 12, 4096, True),
    (3, 64, 512, True),
    (3, 256, 128, True),
    (3, 1000, 32, True),
    (20, 1000, 2, True),
    (100, 1000, 2, True),
]
"""UAVs, devices, layouts at once, whether there is a depot."""

DECISIONS = [(1, 12), (2, 12), (3, 12), (3, 64), (20, 1000)]
"""UAVs and devices; with a depot."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3.0, help="per measurement of the environment")
    parser.add_argument("--decisions", type=int, default=20, help="decisions per measurement of a policy")
    parser.add_argument("--most-devices", type=int, default=1000, help="leave out larger scenarios")
    parser.add_argument("--out", type=Path, default=Path("results/fleet"))
    arguments = parser.parse_args()
    host.use_all_cores()

    environments = [
        measure_environment(*environment, arguments.seconds)
        for environment in ENVIRONMENTS
        if environment[1] <= arguments.most_devices
    ]
    decisions = [
        row
        for size in DECISIONS
        if size[1] <= arguments.most_devices
        for row in measure_decisions(*size, arguments.decisions)
    ]
    print(f"{'UAVs':>5}{'devices':>9}{'layouts':>9}{'depot':>7}{'slots/s':>13}{'bytes/layout':>14}")
    for row in environments:
        print(
            f"{row['uavs']:>5}{row['devices']:>9}{row['layouts']:>9}{row['depot']!s:>7}{row['slots_per_second']:>13,.0f}"
            f"{row['bytes_per_layout']:>14,}"
        )
    print(f"\n{'UAVs':>5}{'devices':>9}  {'policy':<20}{'ms per decision':>16}{'temporary MB':>14}")
    for row in decisions:
        print(
            f"{row['uavs']:>5}{row['devices']:>9}  {row['policy']:<20}{row['milliseconds']:>16.3f}"
            f"{row['temporary_mb']:>14.1f}"
        )
    command = "uv run python experiments/benchmark_fleet.py"
    report = {"command": command, "environments": environments, "decisions": decisions, **host.describe()}
    write_report(arguments.out / "benchmark_fleet.json", report)


def measure_environment(uavs: int, devices: int, layouts: int, depot: bool, seconds: float) -> dict[str, Any]:
    """Measure the environment under random actions on all cores."""
    speed = environment_speed(layouts, seconds, devices=devices, uavs=uavs, depot=depot)
    _, layout, state = make_instance(uavs, devices, depot)
    size = sum(leaf.nbytes for leaf in jax.tree.leaves((layout, state)))
    return {
        "uavs": uavs,
        "devices": devices,
        "layouts": layouts,
        "depot": depot,
        "slots_per_second": round(speed),
        "bytes_per_layout": size,
    }


def make_instance(uavs: int, devices: int, depot: bool) -> tuple[Params, Layout, State]:
    """Return a random scenario as dense as the paper's, in its initial state."""
    side = 800.0 * (devices / 12) ** 0.5
    params = Params(n_devices=devices, region_m=(side, side), max_slots=64)
    depots = make_depots([[0.0, 0.0]]) if depot else None
    layout = sample_layout(jax.random.key(0), params, 2 * devices // 3, 2 * devices // 3)
    layout = layout.replace(fleet=make_fleet(params, uavs, depots), depots=depots)
    return params, layout, initial_state(params, layout)


def measure_decisions(uavs: int, devices: int, count: int) -> list[dict[str, Any]]:
    """Measure one decision of each policy after compilation, the median of ``count``."""
    params, layout, state = make_instance(uavs, devices, depot=True)
    policies: dict[str, Policy] = {"earliest-deadline": earliest_deadline, "split-deadline": split_deadline}
    if devices <= 64:
        policies["rollout, 4 samples"] = rollout_planner()
    rows = []
    for name, policy in policies.items():
        decide = jax.jit(policy).lower(params, layout, state, jax.random.key(0)).compile()
        times = []
        for decision in range(count + 1):
            tick = time.perf_counter()
            jax.block_until_ready(decide(params, layout, state, jax.random.key(decision)))
            times.append(time.perf_counter() - tick)
        memory = decide.memory_analysis()
        rows.append(
            {
                "uavs": uavs,
                "devices": devices,
                "policy": name,
                "milliseconds": 1e3 * statistics.median(times[1:]),
                "temporary_mb": memory.temp_size_in_bytes / 1e6 if memory else float("nan"),
            }
        )
    return rows


if __name__ == "__main__":
    main()

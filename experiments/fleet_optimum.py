"""How far rules, planners and the upper bound are from the optimum of small fleets, found by exhaustive search.

    PYTHONPATH=. uv run python experiments/fleet_optimum.py [--instances 100] [--out results/fleet]

The instances are those of the tests: two UAVs, 3 or 4 devices, a depot or none, batteries equal or not. Prints a table and
writes ``fleet_optimum.json``. Where the optimum is known, the gap between planners and bound is either the planners' or the
bound's.
"""

import argparse
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pandas as pd
from reports import write_report

from tests.planning.fleet_instances import solved_instance
from uavmec_jax.env.rollout import rollout
from uavmec_jax.planning.beam import beam_search
from uavmec_jax.planning.bound import upper_bound
from uavmec_jax.planning.heuristics import FLEET_HEURISTICS
from uavmec_jax.planning.rollout_planner import rollout_planner
from uavmec_jax.studies.statistics import mean_interval

POLICIES = {
    **{name: FLEET_HEURISTICS[name] for name in ("oldest-first", "earliest-deadline", "split-deadline")},
    "rollout planner": rollout_planner(samples=4),
}
WIDTHS = (16, 64, 2048)

search = jax.jit(beam_search, static_argnames="width")


@partial(jax.jit, static_argnames="name")
def lifetime_of(name, params, layout, key):
    return rollout(POLICIES[name], params, layout, key).length


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instances", type=int, default=100, help="seeds; those that take too long are left out")
    parser.add_argument("--out", type=Path, default=Path("results/fleet"))
    arguments = parser.parse_args()
    solved = pd.DataFrame([row for seed in range(arguments.instances) if (row := solve(seed)) is not None])
    report = {"instances": arguments.instances, "solved": len(solved), "without depot": {}, "with depot": {}}
    for depots, rows in solved.groupby("depots"):
        report["with depot" if depots else "without depot"] = {
            "instances": len(rows),
            "optimum, slots": mean_interval(rows["optimum"].to_numpy()),
            **{name: compared(rows[name], rows["optimum"]) for name in (*POLICIES, *map(beam_name, WIDTHS), "bound")},
        }
    print(pd.DataFrame({side: report[side] for side in ("without depot", "with depot")}).to_string())
    write_report(arguments.out / "fleet_optimum.json", report)


def beam_name(width: int) -> str:
    return f"beam, width {width}"


def solve(seed: int) -> dict[str, int] | None:
    """Return the lifetimes of everything on one instance; ``None`` if the optimum takes too long to find."""
    if (solved := solved_instance(seed)) is None:
        return None
    params, layout, key, volumes, optimum = solved
    lifetimes = {name: int(lifetime_of(name, params, layout, key)) for name in POLICIES}
    lifetimes |= {beam_name(width): int(search(params, layout, volumes, width=width).lifetime) for width in WIDTHS}
    bound = upper_bound(params, layout, volumes)
    return {"seed": seed, "depots": layout.n_depots, "optimum": int(optimum.lifetime), **lifetimes, "bound": bound}


def compared(lifetimes: pd.Series, optimum: pd.Series) -> dict[str, float]:
    """Return the mean lifetime as a percentage of the mean optimum, and in how many instances they are equal."""
    return {
        "% of the optimum": round(100 * lifetimes.mean() / optimum.mean(), 1),
        "equal in %": round(100 * float(np.mean(lifetimes == optimum)), 1),
    }


if __name__ == "__main__":
    main()

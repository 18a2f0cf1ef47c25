"""How long the slots of fleets are: lifetimes in slots beside lifetimes in hours, for a rule and for the beam.

    uv run python experiments/fleet_slot_lengths.py [--uavs 3] [--powered 4] [--connected 12] [--out results/fleet]

Plays the first 20 scenarios of a cell of the study ``fleet``, prints a table and writes ``fleet_slot_lengths.json``.
"""

import argparse
from pathlib import Path

import jax
import numpy as np
import pandas as pd
from jaxtyping import Array, Int
from reports import write_report

from uavmec_jax.env.rollout import tour_policy, trace
from uavmec_jax.planning.fleet_deadlines import earliest_deadline
from uavmec_jax.planning.fleet_demand import planned_slots
from uavmec_jax.planning.parallel import beam_episodes
from uavmec_jax.studies.parts import split_study
from uavmec_jax.studies.planner_evaluation import flatten_draws
from uavmec_jax.studies.population import evaluation_keys, make_agents
from uavmec_jax.studies.study import load_study


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--uavs", type=int, default=3)
    parser.add_argument("--powered", type=int, default=4)
    parser.add_argument("--connected", type=int, default=12)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("results/fleet"))
    arguments = parser.parse_args()
    cell = {name: getattr(arguments, name) for name in ("powered", "connected", "uavs")}
    axes = {f"axes.{name}": [value] for name, value in cell.items()} | {"axes.seeds": arguments.seeds}
    study = split_study(load_study("fleet", axes))[0].study
    params, layouts, keys = flatten_draws(make_agents(study).scenario, evaluation_keys(study)[:, :1])
    slots = planned_slots(params, layouts)
    tours, _ = beam_episodes(params, layouts, keys, slots=slots, width=study.evaluation.beam_width)

    @jax.jit
    def play(tour: Int[Array, "H K"] | None, *scenario: Array) -> tuple[Array, Array]:
        played = trace(earliest_deadline if tour is None else tour_policy(tour), *scenario, slots)
        return played.state.slot[-1], played.state.elapsed[-1]

    rows = []
    for index in range(arguments.seeds):
        scenario, tour = jax.tree.map(lambda leaf, index=index: leaf[index], ((params, layouts, keys), tours))
        row = {"seed": index}
        for name, of in (("rule", None), ("beam", tour)):
            lived, elapsed = play(of, *scenario)
            row |= {f"{name}_slots": int(lived), f"{name}_hours": round(float(elapsed) / 3600, 2)}
        rows.append(row)
    table = pd.DataFrame(rows)
    print(table.to_string(index=False))
    mean = {name: round(float(np.mean(table[name])), 2) for name in table if name != "seed"}
    print(mean)
    write_report(arguments.out / "fleet_slot_lengths.json", {"cell": cell, "mean": mean, "scenarios": rows})


if __name__ == "__main__":
    main()

"""How many seconds a learner takes to a policy that stays near the upper bound: PQN, DQN, PPO, and Stable-Baselines3's DQN.

    uv run --group sb3 python experiments/time_to_quality.py [--seeds 10] [--out results/table5-best]

One agent on each of 250 layouts, ten in each of the 25 cells. At every look the present weights play 20 held-out draws, whose
upper bound is known; the looks do not count as time. The time of an agent is the wall time of the population divided by its
agents. Stable-Baselines3 trains with the nearest setting that it has (see `sb3_quality.py`) on five of the layouts,
one agent per process and core; its time is that of all agents on all cores divided by the agents. Without the group `sb3` it
is left out. Writes `time_to_quality.json`, `.csv` and `.png`; with `--learners` or `--no-sb3`, the other learners keep their
rows of an earlier table in the same folder.
"""

import argparse
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from quality_figure import quality_figure
from reports import write_report
from sb3_quality import DRAWS, bound_of, measure_sb3

from uavmec_jax.studies.population import evaluation_keys, make_agent_ids, make_agents, make_algorithm
from uavmec_jax.studies.study import load_study
from uavmec_jax.training import host
from uavmec_jax.training.chunks import Validation
from uavmec_jax.training.partition import partition_population
from uavmec_jax.training.population import take_padded
from uavmec_jax.training.training import Trainer

SHARES = (0.90, 0.95, 0.97, 0.98)
"""Shares of the bound above which a learner is to stay."""
LEARNERS: dict[str, tuple[str, dict[str, Any]]] = {
    "PQN (table5-best)": ("table5-best", {}),
    "PQN, 300,000 steps": ("table5-best", {"steps": 300_000}),
    "PQN, 300,000 steps, guided by oldest-first": ("table5-best", {"pqn.guide": "oldest-first", "steps": 300_000}),
    "PQN, 300,000 steps, not guided": ("table5-best", {"pqn.guide": "none", "steps": 300_000}),
    "DQN (table5-best-dqn)": ("table5-best-dqn", {}),
    "DQN (the paper's settings)": ("table5", {"steps": 300_000}),
    "PPO, paid one per slot": ("table5", {"algorithm": "ppo", "reward": {}, "slot_reward": 1.0, "steps": 300_000}),
}
"""Study and changes of each learner."""
_BOUNDS: dict[bytes, np.ndarray] = {}


def measure(name: str, seeds: int, every: int, steps: int | None) -> pd.DataFrame:
    """Train a learner's population and return its curve: steps, seconds of an agent, shares of the bound."""
    study, changes = LEARNERS[name]
    changes = changes | {"axes.seeds": seeds, "evaluation.draws": DRAWS} | ({"steps": steps} if steps else {})
    resolved = load_study(study, changes)
    algorithm, agents = make_algorithm(resolved), make_agents(resolved)
    assert algorithm is not None
    keys = evaluation_keys(resolved)[:, :DRAWS]
    n = keys.shape[0]
    partition = partition_population(n, algorithm.agent_bytes, host.free_memory())
    size = partition.shard_size
    validation = Validation(every=every, draws=DRAWS, chunks=1)
    trainer = Trainer.compile(algorithm, *take_padded((agents, keys), 0, size), validation, partition)
    seconds, scores = np.zeros(len(trainer.chunks)), []
    for shard in range(partition.shards):
        training = trainer.start(*take_padded((agents, keys), shard * size, size))
        for _ in training.run():
            seconds[training.chunks_done - 1] += training.seconds["train"]
        scores.append(np.stack(training.scores, 1)[: min(size, n - shard * size)])
    lifetimes = np.concatenate(scores)
    bounds = bounds_of(agents, keys)
    cells = pd.Index([(agent["powered"], agent["connected"]) for agent in make_agent_ids(resolved)])
    by_cell = pd.DataFrame(lifetimes).groupby(cells).mean().div(pd.Series(bounds).groupby(cells).mean(), axis=0)
    look_steps = [chunk.last * algorithm.steps_per_iteration for chunk in trainer.chunks]
    return pd.DataFrame(
        {
            "learner": name,
            "agents": n,
            "steps": look_steps,
            "seconds": seconds / n,
            "share": lifetimes.mean(0) / bounds.mean(),
            "worst_cell": by_cell.min().to_numpy(),
        }
    )


def bounds_of(agents: Any, keys: Any) -> np.ndarray:
    """Return :func:`bound_of`, which is computed once for the same layouts and draws."""
    layouts = agents.scenario.layout
    digest = np.asarray(layouts.position).tobytes() + np.asarray(layouts.has_power).tobytes()
    if digest not in _BOUNDS:
        _BOUNDS[digest] = bound_of(agents, keys)
    return _BOUNDS[digest]


def time_to(curve: pd.DataFrame, share: float, column: str = "share") -> float:
    """Return the seconds of an agent after which it stays above a share of the bound; NaN if it does not."""
    below = np.flatnonzero(curve[column].to_numpy() < share)
    first = below[-1] + 1 if len(below) else 0
    return float(curve["seconds"].iloc[first]) if first < len(curve) else float("nan")


def with_earlier(curves: list[pd.DataFrame], path: Path) -> list[pd.DataFrame]:
    """Return the curves and those of an earlier table whose learners are not among them, in the order of that table."""
    if not path.exists():
        return curves
    earlier = {str(name): curve for name, curve in pd.read_csv(path).groupby("learner", sort=False)}
    return list((earlier | {str(curve["learner"].iloc[0]): curve for curve in curves}).values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="layouts in each of the 25 cells")
    parser.add_argument("--steps", type=int, help="of every learner, for a test of the script")
    parser.add_argument("--every", type=int, default=10_000, help="steps between looks")
    parser.add_argument("--learners", nargs="+", choices=list(LEARNERS), default=list(LEARNERS))
    parser.add_argument("--no-sb3", action="store_true", help="leave Stable-Baselines3 out")
    parser.add_argument("--out", type=Path, default=Path("results/table5-best"))
    arguments = parser.parse_args()
    host.use_all_cores()
    curves = []
    if find_spec("stable_baselines3") is not None and not arguments.no_sb3:
        curves.append(measure_sb3())
    for name in arguments.learners:
        curves.append(measure(name, arguments.seeds, arguments.every, arguments.steps))
        share, seconds = curves[-1][["share", "seconds"]].iloc[-1]
        print(f"{name}: {share:.2%} of the bound, {seconds:.2f} s", flush=True)
    report_on(with_earlier(curves, arguments.out / "time_to_quality.csv"), arguments.out)


def report_on(curves: list[pd.DataFrame], out: Path) -> None:
    """Write the table, the figure, and the seconds to each share of the bound."""
    command = " ".join(["python experiments/time_to_quality.py", *sys.argv[1:]])
    report: dict[str, Any] = {"command": command, **host.describe(), "learners": {}}
    for curve in curves:
        seconds = {f"{share:.2f}": time_to(curve, share) for share in SHARES}
        times = {share: None if np.isnan(spent) else round(spent, 4) for share, spent in seconds.items()}
        last = {"share": float(curve["share"].iloc[-1]), "worst_cell": float(curve["worst_cell"].iloc[-1])}
        spread = float(np.ptp(curve["share"].iloc[-20:]) / curve["share"].iloc[-20:].mean())
        name, agents = str(curve["learner"].iloc[0]), int(curve["agents"].iloc[0])
        learner = {"agents": agents, "seconds_to": times, "last": last, "spread_of_mean_over_20_looks": spread}
        report["learners"][name] = learner
        print(name, times, last, round(spread, 4))
    write_report(out / "time_to_quality.json", report)
    table = pd.concat(curves)
    table.to_csv(out / "time_to_quality.csv", index=False, float_format="%.5g")
    quality_figure(table, out / "time_to_quality.png")


if __name__ == "__main__":
    main()

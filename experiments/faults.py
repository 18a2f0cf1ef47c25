"""Fifty faults while a study runs on Ray: every run must end with the bits of an undisturbed one.

    uv run python experiments/faults.py [--out results/faults] [--seed 0]

A cluster of three nodes, each a set of processes on this machine, carries out a small study of two algorithms in six shards.
Faults strike at random moments: a process of a shard is killed, a node is killed and replaced, a node joins, the driver is
killed and resumed, the head is killed, the disk is full, a bit flips in the newest checkpoint, an attempt hangs past its time
limit. A run whose driver ended with one line and exit code 2 is resumed. Programs are compiled once, into JAX's cache of
compiled programs. Writes `faults.csv` and `faults.json`.
"""

import argparse
import os
import random
import time
from pathlib import Path

import pandas as pd
from fault_kinds import FAULTS, NODES, Run, new_nodes
from reports import write_report

STUDY = """
name = "faults"
reward = {}
slot_reward = 1.0
steps = 200_000
[axes]
algorithm = ["a2c", "pqn"]
powered = [12, 8, 4]
connected = [8]
seeds = 2
[evaluation]
draws = 4
validate_every = 20_000
validation_draws = 2
planners = []
baselines = ["oldest-first"]
"""
FILES = ("agents.csv", "curves.npz", "evaluation.npz", "weights.npz", "study.toml")
RESUMES = 6
PLAN = {
    "process of a shard killed": 12,
    "node killed": 8,
    "node added": 4,
    "driver killed": 8,
    "bit flipped in a checkpoint": 6,
    "disk full": 4,
    "attempt hangs": 4,
    "head killed": 4,
}


def disturbed(run: Run, left: list[str]) -> list[dict]:
    """Carry a run out while faults strike, at most three of them; return a row for each."""
    rows: list[dict] = []
    run.start()
    for _ in range(1 + RESUMES):
        while left and len(rows) < 3 and run.wait_for_a_moment():
            kind = left[-1]
            started = time.monotonic()
            if FAULTS[kind](run):
                rows.append(
                    {"fault": left.pop(), "run": run.folder.name, "seconds_into": round(time.monotonic() - started, 1)}
                )
        code = run.end()
        if code == 0:
            break
        run.start(ray=run.chance.random() > 0.5)
    else:
        raise AssertionError(f"{run.folder}: does not end, however often it is resumed: {run.lines}")
    for row in rows:
        row["lines"] = len(run.lines)
        row["line"] = " | ".join(run.lines)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/faults"))
    parser.add_argument("--work", type=Path, default=Path("runs/faults"), help="folder of the runs")
    parser.add_argument("--faults", type=int, help="of each kind, for a test of the script")
    parser.add_argument("--kinds", nargs="+", choices=PLAN, default=list(PLAN), help="which faults strike")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    work = arguments.work.absolute()
    work.mkdir(parents=True)
    (work / "faults.toml").write_text(STUDY)
    os.environ |= {"JAX_COMPILATION_CACHE_DIR": str(work / "cache"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    chance = random.Random(arguments.seed)
    left = [kind for kind in arguments.kinds for _ in range(min(PLAN[kind], arguments.faults or PLAN[kind]))]
    chance.shuffle(left)
    nodes = new_nodes()
    whole = Run(work / "whole", nodes, chance)
    whole.start(ray=False)
    assert whole.end() == 0, whole.lines
    bits = {name: (whole.folder / name).read_bytes() for name in FILES}
    rows: list[dict] = []
    for number in range(4 * len(left)):  # a run may end before a fault strikes
        if not left:
            break
        run = Run(work / f"run-{number:02d}", nodes, chance)
        started = time.monotonic()
        new = disturbed(run, left)
        nodes = run.nodes
        same = all((run.folder / name).read_bytes() == content for name, content in bits.items())
        rows += [row | {"same_bits": same, "run_seconds": round(time.monotonic() - started, 1)} for row in new]
        print(f"{run.folder.name}: {[row['fault'] for row in new]}, same bits {same}, {run.lines}", flush=True)
        for node in nodes.workers[NODES:]:
            nodes.kill(node)
    nodes.shutdown()
    report(pd.DataFrame(rows), arguments.out)


def report(table: pd.DataFrame, out: Path) -> None:
    """Write every fault, and a summary by kind."""
    out.mkdir(parents=True, exist_ok=True)
    table.to_csv(out / "faults.csv", index=False)
    by_kind = table.groupby("fault", sort=False).agg(faults=("run", "size"), same_bits=("same_bits", "sum"))
    from uavmec_jax.training import host

    summary = {
        "command": "uv run python experiments/faults.py",
        "faults": len(table),
        "kinds": by_kind.to_dict("index"),
    }
    write_report(out / "faults.json", summary | host.describe())
    print(by_kind.to_string())


if __name__ == "__main__":
    main()

"""Fifty faults while a study runs on Ray: every run must end with the bits of an undisturbed one.

    uv run python experiments/faults.py [--out results/faults] [--seed 0]

A cluster of three nodes, each a set of processes on this machine, carries out a small study of two algorithms in six shards.
Faults strike at random moments: a process of a shard is killed, a node is killed and replaced, a node joins, the driver is
killed and resumed, the head is killed, the disk is full, a bit flips in the newest checkpoint, an attempt hangs past its time
limit. A run whose driver ended with one line and exit code 2 is resumed. Writes `faults.csv` and `faults.json`.
"""

import argparse
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd
import psutil
from reports import write_report

from uavmec_jax.cluster.connection import prepare_environment
from uavmec_jax.cluster.options import LOCAL

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
OPTIONS = ["--shard-size", "2", "--checkpoint-every", "0", "--checkpoint-share", "0.3"]
FILES = ("agents.csv", "curves.npz", "evaluation.npz", "weights.npz", "study.toml")
NODES, CPUS = 3, 2
TIME_LIMIT_S = 20
PATIENCE_S = 300.0
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


@dataclass
class Nodes:
    """A cluster whose nodes are processes of this machine."""

    def __post_init__(self) -> None:
        from ray.cluster_utils import Cluster

        head = {"num_cpus": 0, "node_ip_address": "127.0.0.1", "include_dashboard": False}
        self.cluster = Cluster(initialize_head=True, head_node_args=head)
        for _ in range(NODES):
            self.add()

    @property
    def address(self) -> str:
        return str(self.cluster.address)

    def add(self) -> None:
        self.cluster.add_node(num_cpus=CPUS, node_ip_address="127.0.0.1")

    def kill(self, node: object) -> None:
        self.cluster.remove_node(node, allow_graceful=False)

    def kill_head(self) -> None:
        for process in psutil.Process().children(recursive=True):
            if process.name() == "gcs_server":
                process.kill()

    def shutdown(self) -> None:
        self.cluster.shutdown()


@dataclass
class Run:
    """A run, its present driver, and what became of it."""

    folder: Path
    nodes: Nodes
    chance: random.Random
    lines: list[str] = field(default_factory=list)
    process: subprocess.Popen | None = None
    limit: list[str] = field(default_factory=list)

    def start(self, *, ray: bool = True) -> None:
        """Start the run, or resume it, with or without Ray."""
        resumes = (self.folder / "run_plan.json").exists()
        what = ["resume", str(self.folder)] if resumes else ["run", "faults.toml", *OPTIONS, "--out", str(self.folder)]
        on_ray = ["--cpus-per-shard", str(CPUS), *self.limit, "--ray", self.nodes.address] if ray else []
        self.process = subprocess.Popen(
            [sys.executable, "-m", "uavmec_jax", *what, *on_ray],
            cwd=self.folder.parent,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def end(self) -> int:
        """Wait for the driver; return its exit code, and keep the line with which it gave up.

        Raises:
            AssertionError: it gave up in another way than with one line and exit code 2.
        """
        assert self.process is not None
        _, errors = self.process.communicate(timeout=PATIENCE_S)
        code = self.process.returncode
        if code not in (0, -signal.SIGKILL, 128 + signal.SIGTERM):
            *others, last = [line for line in errors.splitlines() if not line.startswith("[")]  # those are Ray's own
            assert code == 2 and not others, f"exit code {code}: {errors}"  # noqa: PT018
            self.lines.append(last)
        return code

    @property
    def ended(self) -> bool:
        """Whether the driver has ended."""
        return self.process is None or self.process.poll() is not None

    def running(self) -> list[dict]:
        """Return the reports of attempts whose processes are alive."""
        reports = [_read(file) for file in self.folder.glob("shards/*/progress-*.json")]
        return [one for one in reports if one.get("state") == "running" and psutil.pid_exists(one["pid"])]

    def checkpoints(self) -> list[Path]:
        """Return the newest checkpoint of each shard in training."""
        newest = [max(folder.glob("checkpoint-*.npz"), default=None) for folder in self.folder.glob("shards/0*")]
        return [path for path in newest if path is not None]

    def wait(self, condition: Callable[[], object]) -> bool:
        """Wait until something is the case; return whether it is before the driver ends."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            if self.ended:
                return False
            if time.monotonic() > deadline:
                raise TimeoutError(f"{self.folder}: nothing happens")
            time.sleep(0.05)
        return True

    def wait_for_a_moment(self) -> bool:
        """Wait until shards are in training, and then for a random time; return whether the driver is still there."""
        if not self.wait(lambda: self.running() and self.checkpoints()):
            return False
        time.sleep(self.chance.uniform(0.0, 4.0))
        return not self.ended


def _read(file: Path) -> dict:
    try:
        return dict(json.loads(file.read_text()))
    except (OSError, ValueError):
        return {}


def kill_process(run: Run) -> bool:
    """Kill the process of a shard in training."""
    if running := run.running():
        os.kill(run.chance.choice(running)["pid"], signal.SIGKILL)
    return bool(running)


def kill_node(run: Run) -> bool:
    """Kill a node with everything on it, and add another."""
    run.nodes.kill(run.chance.choice(sorted(run.nodes.cluster.worker_nodes, key=str)))
    run.nodes.add()
    return True


def add_node(run: Run) -> bool:
    """Add a node, and take it away again at the end of the run."""
    run.nodes.add()
    return True


def kill_driver(run: Run) -> bool:
    """Kill the driver, and resume: every third time without Ray."""
    assert run.process is not None
    run.process.kill()
    run.end()
    run.start(ray=run.chance.random() > 1 / 3)
    return True


def flip_bit(run: Run) -> bool:
    """Stop the run, flip a bit of a newest checkpoint, and resume."""
    stop(run)
    if not (found := run.checkpoints()):
        run.start()
        return False
    path = run.chance.choice(found)
    content = bytearray(path.read_bytes())
    content[run.chance.randrange(len(content))] ^= 1 << run.chance.randrange(8)
    path.write_bytes(bytes(content))
    run.start()
    return True


def fill_disk(run: Run) -> bool:
    """Let a process write no file of more than 1,000 bytes, as on a full disk, until it has noticed."""
    if not (running := run.running()):
        return False
    pid = run.chance.choice(running)["pid"]
    try:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (1000, 1000))
    except ProcessLookupError:
        return False
    return True


def hang(run: Run) -> bool:
    """Let an attempt read a checkpoint that never comes: a pipe into which nobody writes."""
    stop(run)
    if not (found := run.checkpoints()):
        run.start()
        return False
    pipe = found[0].parent / "checkpoint-999999-00-000000.npz"
    os.mkfifo(pipe)
    run.limit = ["--time-limit", str(TIME_LIMIT_S)]
    run.start()
    run.wait(lambda: "process or node is lost" in _log(run) or '"lost"' in _log(run))
    pipe.unlink(missing_ok=True)
    return True


def kill_head(run: Run) -> bool:
    """Kill the head: the driver must end with one line; a new cluster goes on."""
    run.nodes.kill_head()
    run.end()
    run.nodes.shutdown()
    run.nodes = Nodes()
    run.start()
    return True


def stop(run: Run) -> None:
    """Stop the driver, which lets the shards save their work."""
    assert run.process is not None
    run.process.send_signal(signal.SIGTERM)
    run.end()


def _log(run: Run) -> str:
    return "".join(file.read_text(errors="replace") for file in (run.folder / "log").glob("*.jsonl"))


FAULTS: dict[str, Callable[[Run], bool]] = {
    "process of a shard killed": kill_process,
    "node killed": kill_node,
    "node added": add_node,
    "driver killed": kill_driver,
    "bit flipped in a checkpoint": flip_bit,
    "disk full": fill_disk,
    "attempt hangs": hang,
    "head killed": kill_head,
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
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    prepare_environment(LOCAL)
    work = arguments.work.absolute()
    work.mkdir(parents=True)
    (work / "faults.toml").write_text(STUDY)
    chance = random.Random(arguments.seed)
    left = [kind for kind, count in PLAN.items() for _ in range(min(count, arguments.faults or count))]
    chance.shuffle(left)
    nodes = Nodes()
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
        while len(nodes.cluster.worker_nodes) > NODES:
            nodes.kill(next(iter(nodes.cluster.worker_nodes)))
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

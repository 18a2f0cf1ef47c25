"""Runs on Ray and the faults that can strike them, for the campaign in `faults.py`."""

import ctypes
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil
from simulated_nodes import SimulatedNodes

OPTIONS = ["--shard-size", "2", "--checkpoint-every", "0", "--checkpoint-share", "0.3"]
NODES, CPUS = 3, 2
TIME_LIMIT_S = 60
"""Longer than three nodes take to start and to train on two cores; an attempt that hangs is ended after it."""
PATIENCE_S = 600.0
PTRACE_SEIZE, PTRACE_INTERRUPT, WAIT_FOR_ALL = 0x4206, 0x4207, 0x40000000
"""Numbers of Linux, which Python does not name."""


def new_nodes() -> SimulatedNodes:
    """Start a cluster."""
    return SimulatedNodes(NODES, CPUS)


@dataclass
class Run:
    """A run, its present driver, and what became of it."""

    folder: Path
    nodes: SimulatedNodes
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
            self.lines.append(last.replace(f"{self.folder.parent}/", ""))
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
    run.nodes.kill(run.chance.choice(run.nodes.workers))
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
    """Stop the main thread of an attempt, as a file server that does not answer would: its process is alive, and silent."""
    stop(run)
    lost = _log(run).count('"lost"')
    run.limit = ["--time-limit", str(TIME_LIMIT_S)]
    run.start()
    if not run.wait(run.running):
        return False
    pid = run.chance.choice(run.running())["pid"]
    if not _stop_main_thread(pid):
        return False

    def is_lost() -> bool:
        _collect(pid)
        return _log(run).count('"lost"') > lost

    run.wait(is_lost)
    return True


def _stop_main_thread(pid: int) -> bool:
    """Stop one thread of a process, which no signal can; return whether the process was still there."""
    ptrace = ctypes.CDLL(None, use_errno=True).ptrace
    ptrace.argtypes, ptrace.restype = (ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p), ctypes.c_long
    return all(ptrace(request, pid, None, None) == 0 for request in (PTRACE_SEIZE, PTRACE_INTERRUPT))


def _collect(pid: int) -> None:
    """Let a process whose thread was stopped disappear when it has ended: its parent learns of it only then."""
    with suppress(ChildProcessError):
        os.waitpid(pid, WAIT_FOR_ALL | os.WNOHANG)


def kill_head(run: Run) -> bool:
    """Kill the head: the driver must end with one line; a new cluster goes on."""
    run.nodes.kill_head()
    run.end()
    run.nodes.shutdown()
    run.nodes = new_nodes()
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

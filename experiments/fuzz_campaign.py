"""The process that does the inputs, and the one that watches it, counts, and replaces it if it dies."""

import multiprocessing
import resource
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import jax
import psutil
from fuzz_calls import CALLS
from fuzz_files import file_kinds
from fuzz_judge import Verdict
from fuzz_worker import CALL, OPTIONS, Worker

_OPTIONS_WEIGHT = 60
_PATIENCE_S = 200.0
"""Seconds in which an input must end, or its process is killed: some code never lets a signal through."""

_MEMORY_BYTES = 6 * 2**30
"""What a process may map beyond what it has mapped when it begins."""

_MOST_RESIDENT_BYTES = 3e9
"""Memory with which a process lets another one go on: compiled programs stay in memory."""

Task = tuple[str, int, int]
"""A kind, its first number, and one past the last."""


def shares(inputs: int, calls: int, corpus: Path, only: list[str] | None) -> list[Task]:
    """Share the inputs out to the kinds of files and the options, and the calls to the functions."""
    files = {name: kind.weight for name, kind in file_kinds(corpus).items()} | {OPTIONS: _OPTIONS_WEIGHT}
    functions = {CALL + name: call.weight for name, call in CALLS.items()}
    tasks = []
    for weights, total in ((files, inputs), (functions, calls)):
        chosen = {name: weight for name, weight in weights.items() if not only or any(word in name for word in only)}
        scale = total / max(sum(chosen.values()), 1)
        tasks += [(name, 0, count) for name, weight in chosen.items() if (count := round(weight * scale))]
    return tasks


def _work(seed: int, work: Path, tasks: list[Task], connection: Connection) -> None:
    """Do inputs in this process, and send what became of each."""
    jax.devices()
    worker = Worker(seed, work)
    soft = psutil.Process().memory_info().vms + _MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (soft, soft))
    for name, first, last in tasks:
        if (verdict := worker.warm_up(name)) is not None:
            connection.send((name, last - 1, verdict))
            continue
        connection.send(None)
        for number in range(first, last):
            connection.send((name, number, replace(worker.do(name, number), trace="")))
            if number % 100 == 0 and psutil.Process().memory_info().rss > _MOST_RESIDENT_BYTES:
                return
    connection.send(())


@dataclass
class Counts:
    """What became of the inputs of a kind."""

    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    failures: int = 0
    seconds: float = 0.0
    slowest: dict[str, Any] = field(default_factory=lambda: {"case": "", "seconds": 0.0})

    def add(self, verdict: Verdict, case: str) -> None:
        """Count an input."""
        self.inputs += 1
        self.accepted += verdict.outcome == "accepted"
        self.refused += verdict.outcome == "refused"
        self.failures += verdict.outcome == "failure"
        self.seconds += verdict.seconds
        if verdict.seconds > self.slowest["seconds"]:
            self.slowest = {"case": case, "seconds": round(verdict.seconds, 3)}

    def plain(self) -> dict[str, Any]:
        """Return the counts as plain data."""
        return vars(self) | {"seconds": round(self.seconds, 1)}


@dataclass
class Campaign:
    """Watches the process that does the inputs.

    Attributes:
        seed: of all inputs.
        work: the folder of :class:`Worker`, for one campaign at a time.
        tell: called with a line for every kind that is done.
    """

    seed: int
    work: Path
    tell: Callable[[str], None] = print
    counts: dict[str, Counts] = field(default_factory=dict)
    failures: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)

    def run(self, tasks: list[Task]) -> dict[str, Any]:
        """Do all inputs, and return the report."""
        while tasks:
            tasks = self._watch(tasks)
        everything = Counts()
        for counts in self.counts.values():
            for name in ("inputs", "accepted", "refused", "failures", "seconds"):
                setattr(everything, name, getattr(everything, name) + getattr(counts, name))
            everything.slowest = max(everything.slowest, counts.slowest, key=lambda one: one["seconds"])
        return {
            "all": everything.plain(),
            "kinds": {name: counts.plain() for name, counts in self.counts.items()},
            "failures": sorted(self.failures.values(), key=lambda row: (row["what"], row["where"])),
        }

    def _watch(self, tasks: list[Task]) -> list[Task]:
        """Let one process work until all is done, or it dies or hangs; return what is left."""
        context = multiprocessing.get_context("spawn")
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=_work, args=(self.seed, self.work, tasks, sender))
        process.start()
        sender.close()
        name, number, last = tasks[0]
        try:
            while receiver.poll(_PATIENCE_S):
                message = receiver.recv()
                if message is None:  # it has warmed up
                    continue
                if not message:
                    process.join()
                    return []
                name, done, verdict = message
                self._count(name, done, verdict)
                tasks = [(task, done + 1 if task == name else first, end) for task, first, end in tasks]
                if tasks[0][1] == tasks[0][2]:
                    self.tell(f"{name}: {self.counts[_label(name)].plain()}")
                    tasks = tasks[1:]
                name, number, last = tasks[0] if tasks else ("", 0, 0)
            what = "hang"
            process.kill()
        except EOFError:
            what = "process died"
        process.join()
        if tasks and (what == "hang" or process.exitcode):
            self._count(name, number, Verdict("failure", what, name, f"exit code {process.exitcode}", _PATIENCE_S))
            tasks = [(name, number + 1, last)] * (number + 1 < last) + tasks[1:]
        return tasks

    def _count(self, name: str, number: int, verdict: Verdict) -> None:
        label = _label(name)
        case = f"{name}:{number}"
        self.counts.setdefault(label, Counts()).add(verdict, case)
        if verdict.outcome == "failure":
            row = {
                "what": verdict.what,
                "where": verdict.where,
                "kind": label,
                "first": case,
                "message": verdict.message,
            }
            row = self.failures.setdefault((verdict.what, verdict.where or label), row | {"count": 0})
            row["count"] += 1


def _label(name: str) -> str:
    """Return the row in which a kind is counted: all calls are in one."""
    return "calls" if name.startswith(CALL) else name

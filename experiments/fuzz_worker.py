"""Doing inputs one after another, each from its seed, kind and number, in a folder that is as it should be."""

import multiprocessing
import os
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from fuzz_calls import CALLS, make_call
from fuzz_corpus import make_corpus
from fuzz_files import Kind, file_kinds, make_folder, place_input
from fuzz_judge import ReachedError, Verdict, judge, location, snapshot
from fuzz_options import BASE, command_line, make_options_folder, run_command

OPTIONS = "command line"
"""The kind of inputs that are options."""

CALL = "call of "
"""Beginning of the kinds of calls."""

_CALL_SLOW_S, _CALL_HANG_S = 60.0, 120.0
"""Calls compile programs."""


def corpus_in(work: Path) -> Path:
    """Return the folder of the valid files, which a process of its own makes if it does not exist."""
    corpus = work / "corpus"
    if not (corpus / "done").exists():
        shutil.rmtree(corpus, ignore_errors=True)
        process = multiprocessing.get_context("spawn").Process(target=make_corpus, args=(corpus,))
        process.start()
        process.join()
        if process.exitcode:
            raise SystemExit("the valid files could not be made")
        (corpus / "done").touch()
    return corpus


class Worker:
    """Does inputs, each in a folder that is its own.

    Attributes:
        seed: of all inputs.
        work: holds the corpus, the folder of the inputs, and those that failed.
    """

    def __init__(self, seed: int, work: Path) -> None:
        self._seed = seed
        self._folder, self._failed = work / "input", work / "failed"
        self._corpus = work / "corpus"
        self._kinds = file_kinds(self._corpus)
        self._kind = ""
        self._failed.mkdir(exist_ok=True)

    def do(self, name: str, number: int) -> Verdict:
        """Do one input."""
        rng = Random(f"{self._seed}/{name}/{number}")
        if name.startswith(CALL):
            call = make_call(name.removeprefix(CALL), rng)
            verdict = self._judge(
                name,
                call.make,
                must_refuse=call.must_refuse,
                slow_s=_CALL_SLOW_S,
                hang_s=_CALL_HANG_S,
                other_type=call.other_type,
                finite=call.finite,
            )
            return _with(verdict, call.text)
        if name == OPTIONS:
            line = command_line(rng)
            return _with(self._judge(name, partial(run_command, line)), str(line))
        kind = self._kinds[name]
        self._enter(name)
        place_input(kind, self._folder, rng)
        verdict = self._judge(
            name,
            partial(kind.load, self._folder),
            may_be_infinite=kind.may_be_infinite,
            may_be_nan=kind.may_be_nan,
            may_write=kind.writes,
        )
        if verdict.outcome == "failure":
            self._keep(kind, name, number)
        return verdict

    def warm_up(self, name: str) -> Verdict | None:
        """Use what is valid, which compiles what all inputs of a kind share; return a failure if that does not work."""
        self._kind = ""
        try:
            self._use_valid(name)
        except Exception as error:
            where = f"{location(error.__traceback__)} {type(error).__name__}"
            return Verdict("failure", "a valid input is refused", where, f"{name}: {error}"[:300])
        self._kind = ""
        return None

    def _use_valid(self, name: str) -> None:
        self._enter(name)
        if name == OPTIONS:
            for command, lines in BASE.items():
                for line in lines:
                    with suppress(ReachedError):
                        run_command([*command.split(), *line])
        elif name.startswith(CALL):
            call = CALLS[name.removeprefix(CALL)]
            if call.valid:
                call.function(**call.arguments())
        else:
            kind = self._kinds[name]
            for seed in kind.seeds:
                (self._folder / kind.file).write_bytes(seed)
                kind.load(self._folder)

    def _enter(self, name: str) -> None:
        """Make the folder of a kind, unless it is as it was."""
        if name == self._kind:
            return
        os.chdir(self._folder.parent)
        if name == OPTIONS:
            make_options_folder(self._corpus, self._folder)
        elif name.startswith(CALL):
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder.mkdir()
        else:
            make_folder(self._kinds[name], self._folder)
        os.chdir(self._folder)
        self._kind = name

    def _judge(self, name: str, load: Callable[[], Any], **more: Any) -> Verdict:
        self._enter(name)
        before = snapshot(self._folder)
        verdict = judge(load, self._folder, **more)
        if snapshot(self._folder) != before:
            self._kind = ""  # made anew for the next input
        return verdict

    def _keep(self, kind: Kind, name: str, number: int) -> None:
        """Keep an input that failed."""
        source = self._folder / kind.file
        if source.is_file() and not source.is_symlink():
            label = re.sub(r"\W+", "-", f"{name}-{number}")
            shutil.copy(source, self._failed / f"{label}{source.suffix}")


def _with(verdict: Verdict, given: str) -> Verdict:
    """Add what was given to the message of a failure."""
    if verdict.outcome != "failure":
        return verdict
    return replace(verdict, message=f"{verdict.message} <- {given[:300]}")


def again(case: str, seed: int, work: Path) -> str:
    """Do one input again, and return what became of it."""
    name, _, number = case.rpartition(":")
    corpus_in(work)
    worker = Worker(seed, work)
    verdict = worker.warm_up(name) or worker.do(name, int(number))
    return (
        f"{verdict.trace}{verdict.outcome} {verdict.what} {verdict.where} {verdict.message} ({verdict.seconds:.2f} s)"
    )

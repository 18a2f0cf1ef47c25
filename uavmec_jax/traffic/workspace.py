"""A temporary folder and the processes that work in it; none of them outlives us, however we end."""

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

from uavmec_jax.errors import TrafficError

_GUARDIAN = """
import os, shutil, signal, sys, time
running = set()
for line in sys.stdin:
    sign, pid = line[0], int(line[1:])
    running.add(pid) if sign == "+" else running.discard(pid)
for pid in running:
    try:
        os.kill(pid, signal.SIGTERM if os.name == "nt" else signal.SIGKILL)
    except OSError:
        pass
for _ in range(50):
    shutil.rmtree(sys.argv[1], ignore_errors=True)
    if not os.path.exists(sys.argv[1]):
        break
    time.sleep(0.1)
"""
"""Reads which processes work; when we end, even by SIGKILL, its input ends, and it kills them and removes the folder."""


class Workshop:
    """A context manager: a temporary folder, and programs run in it with a time limit."""

    def __enter__(self) -> "Workshop":
        self.folder = Path(tempfile.mkdtemp(prefix="uavmec-traffic-"))
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen] = set()
        self._closed = False
        self._guardian = subprocess.Popen(
            [sys.executable, "-S", "-E", "-c", _GUARDIAN, str(self.folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,  # who reads what we print does not wait for it
            stderr=subprocess.DEVNULL,
            text=True,
            start_new_session=True,  # Ctrl-C ends the commands of the terminal, not this one
        )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop()
        assert self._guardian.stdin is not None
        with contextlib.suppress(OSError):
            self._guardian.stdin.close()
        self._guardian.wait()
        shutil.rmtree(self.folder, ignore_errors=True)

    def stop(self) -> None:
        """End every program at once; none is started any more."""
        with self._lock:
            self._closed = True
            running = list(self._running)
        for process in running:
            process.kill()

    def run(
        self, name: str, command: Sequence[str | Path], *, limit_s: float, env: Mapping[str, str] | None = None
    ) -> str:
        """Run a program in the folder and return what it printed.

        Args:
            name: of the program, for messages.
            command: the program and its arguments.
            limit_s: seconds after which it is killed.
            env: added to the environment.

        Raises:
            TrafficError: it failed (its last line of error), or took too long.
        """
        with self._start(command, env) as process:
            try:
                out, said = process.communicate(timeout=limit_s)
            except subprocess.TimeoutExpired:
                raise TrafficError(f"{name}: did not end within its limit of {limit_s:g} s and was stopped") from None
            finally:
                process.kill()
                self._tell("-", process)
        if process.returncode != 0:
            raise TrafficError(f"{name}: {last_error(said + out) or f'ended with exit code {process.returncode}'}")
        return out

    def _start(self, command: Sequence[str | Path], env: Mapping[str, str] | None) -> subprocess.Popen:
        with self._lock:
            if self._closed:
                raise TrafficError("stopped before it was started")
            process = subprocess.Popen(
                [str(part) for part in command],
                cwd=self.folder,
                env={**os.environ, **(env or {})},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
            )
            self._running.add(process)
        self._tell("+", process)
        return process

    def _tell(self, sign: str, process: subprocess.Popen) -> None:
        with self._lock:
            if sign == "-":
                self._running.discard(process)
            assert self._guardian.stdin is not None
            with contextlib.suppress(OSError):  # somebody has killed it: then only we clean up
                self._guardian.stdin.write(f"{sign}{process.pid}\n")
                self._guardian.stdin.flush()


def last_error(said: str) -> str:
    """The last line that reports an error, without the word, or the last line of all."""
    lines = [line.strip() for line in said.splitlines() if line.strip() and not line.startswith("Quitting")]
    errors = [line for line in lines if line.startswith("Error")]
    return (errors or lines or [""])[-1].removeprefix("Error:").strip()

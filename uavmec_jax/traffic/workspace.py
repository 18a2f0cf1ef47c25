"""A temporary folder and the processes that run in it; neither outlives this process, however it ends."""

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

_WATCHDOG = """
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
"""A script that reads from its standard input which processes are running. When this process ends, even by SIGKILL, that
input ends too; the script then kills the processes and removes the folder."""


class Workspace:
    """A temporary folder, and programs that run in it with a time limit; a context manager."""

    def __enter__(self) -> "Workspace":
        self.folder = Path(tempfile.mkdtemp(prefix="uavmec-traffic-"))
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen] = set()
        self._stopped = False
        self._watchdog = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _WATCHDOG, str(self.folder)],  # -I: no module of the working folder
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,  # a reader of our output must not wait for the watchdog to end
            stderr=subprocess.DEVNULL,
            text=True,
            start_new_session=True,  # Ctrl-C reaches the processes of the terminal's session, and must not reach this one
        )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop()
        assert self._watchdog.stdin is not None
        with contextlib.suppress(OSError):
            self._watchdog.stdin.close()
        self._watchdog.wait()
        shutil.rmtree(self.folder, ignore_errors=True)

    def stop(self) -> None:
        """Kill all running programs and refuse to start new ones."""
        with self._lock:
            self._stopped = True
            running = list(self._running)
        for process in running:
            process.kill()

    def run(
        self, name: str, command: Sequence[str | Path], *, limit_s: float, env: Mapping[str, str] | None = None
    ) -> str:
        """Run a program in the folder and return what it prints.

        Args:
            name: of the program, for error messages.
            command: the program and its arguments.
            limit_s: seconds after which it is killed.
            env: environment variables, added to those of this process.

        Raises:
            TrafficError: the program failed (the message is its first error) or took too long.
        """
        with self._start(command, env) as process:
            try:
                stdout, stderr = process.communicate(timeout=limit_s)
            except subprocess.TimeoutExpired:
                raise TrafficError(f"{name}: did not end within its limit of {limit_s:g} s and was stopped") from None
            finally:
                process.kill()
                self._notify_watchdog("-", process)
        if process.returncode != 0:
            raise TrafficError(
                f"{name}: {first_error(stderr + stdout) or f'ended with exit code {process.returncode}'}"
            )
        return stdout

    def _start(self, command: Sequence[str | Path], env: Mapping[str, str] | None) -> subprocess.Popen:
        with self._lock:
            if self._stopped:
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
        self._notify_watchdog("+", process)
        return process

    def _notify_watchdog(self, sign: str, process: subprocess.Popen) -> None:
        with self._lock:
            if sign == "-":
                self._running.discard(process)
            assert self._watchdog.stdin is not None
            with contextlib.suppress(OSError):  # the watchdog was killed: then only `__exit__` cleans up
                self._watchdog.stdin.write(f"{sign}{process.pid}\n")
                self._watchdog.stdin.flush()


def first_error(output: str) -> str:
    """Return the first line that reports an error, without the word ``Error``; the last line if none does.

    The first is the cause: SUMO's programs go on to complain about what is missing as a consequence.
    """
    lines = [line.strip() for line in output.splitlines() if line.strip() and not line.startswith("Quitting")]
    errors = [line for line in lines if line.startswith("Error")]
    return (errors[:1] or lines[-1:] or [""])[0].removeprefix("Error:").strip()

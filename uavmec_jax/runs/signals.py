"""SIGINT and SIGTERM end a run between two chunks, so that what it has can be kept."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


class Stopped(KeyboardInterrupt):
    """The run was told to stop; ``signal`` is the one that said so."""

    def __init__(self, signal: int) -> None:
        super().__init__(f"stopped by signal {signal}")
        self.signal = signal


class Stop:
    """While it is entered, the two signals are noted; the run asks, or wants to be interrupted at once.

    Outside the main thread, where Python has no signals, nothing is noted. A second signal interrupts in any case.
    """

    def __init__(self) -> None:
        self.signal = 0
        self._at_once = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "Stop":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Stop here if a signal came.

        Raises:
            Stopped: it did.
        """
        if self.signal:
            raise Stopped(self.signal)

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """A stretch that may be interrupted anywhere."""
        self.check()
        self._at_once = True
        try:
            yield
        finally:
            self._at_once = False

    def _note(self, number: int, _: FrameType | None) -> None:
        again, self.signal = bool(self.signal), number
        if self._at_once or again:
            raise Stopped(number)

"""SIGINT and SIGTERM end a run between two chunks, so that its state can be saved."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


class Interrupted(KeyboardInterrupt):
    """The run was told to stop by the signal number ``signal``."""

    def __init__(self, signal: int) -> None:
        super().__init__(f"stopped by signal {signal}")
        self.signal = signal


class StopSignal:
    """A context in which the two signals are recorded; the run checks them, or allows itself to be interrupted.

    Outside the main thread, where Python has no signals, nothing is recorded. A second signal always interrupts.
    """

    def __init__(self) -> None:
        self.signal = 0
        self._interruptible = False
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> "StopSignal":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._handlers[number] = signal.signal(number, self._record)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Stop here if a signal came.

        Raises:
            Interrupted: it did.
        """
        if self.signal:
            raise Interrupted(self.signal)

    @contextmanager
    def interruptible(self) -> Iterator[None]:
        """Enter a section that may be interrupted anywhere.

        Raises:
            Interrupted: a signal came, before or inside.
        """
        self.check()
        self._interruptible = True
        try:
            yield
        finally:
            self._interruptible = False

    def _record(self, number: int, _: FrameType | None) -> None:
        again, self.signal = bool(self.signal), number
        if self._interruptible or again:
            raise Interrupted(number)

"""End a run at SIGINT and SIGTERM between two chunks, so that its state can be saved."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


class Interrupted(KeyboardInterrupt):
    """The signal with the number ``signal`` stopped the run."""

    def __init__(self, signal: int) -> None:
        super().__init__(f"stopped by signal {signal}")
        self.signal = signal


class StopSignal:
    """Context manager that records the two signals until the run checks for them, or can be interrupted anywhere.

    A second signal always interrupts. Outside the main thread, where Python has no signals, nothing is recorded.
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
        """Stop here if a signal has arrived.

        Raises:
            Interrupted: one has.
        """
        if self.signal:
            raise Interrupted(self.signal)

    @contextmanager
    def interruptible(self) -> Iterator[None]:
        """Enter a section that may be interrupted anywhere.

        Raises:
            Interrupted: a signal arrived, before the section or inside.
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

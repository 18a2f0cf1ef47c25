"""What a run tells while it goes on: JSON lines, one file per process, and TensorBoard's event files if wanted."""

import json
import os
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from uavmec_jax.training import host


class Log:
    """Appends one JSON object per line to a file of this process's own; a line is whole or it is the last.

    Every line has ``event``, ``at`` (the wall clock, for people) and the event's facts; ``on_event`` is told the same.
    """

    def __init__(
        self, folder: Path | None, *, tensorboard: bool = False, on_event: Callable[[str, dict[str, Any]], None]
    ) -> None:
        self._folder = folder
        self._on_event = on_event
        self._file: Any = None
        self._boards: dict[int, Any] = {}
        self._tensorboard = tensorboard
        if tensorboard:
            writer_class()

    def tell(self, event: str, **facts: Any) -> None:
        """One event."""
        if self._folder is not None:
            with suppress(OSError):  # a full disk: what counts is the snapshot, and there it is told
                self._append(json.dumps({"event": event, "at": round(time.time(), 3)} | facts) + "\n")
        self._on_event(event, facts)

    def _append(self, line: str) -> None:
        if self._file is None:
            assert self._folder is not None
            self._folder.mkdir(parents=True, exist_ok=True)
            self._file = (self._folder / f"{socket.gethostname()}-{os.getpid()}.jsonl").open("ab", buffering=0)
        self._file.write(line.encode())

    def curve(self, shard: int, steps: int, **values: float) -> None:
        """Points of a shard's curves, at a number of environment steps of one agent."""
        self.tell("chunk", shard=shard, steps=steps, **values)
        if self._tensorboard and self._folder is not None:
            if shard not in self._boards:
                folder = self._folder.parent / "tensorboard" / f"shard-{shard:05d}"
                self._boards[shard] = writer_class()(str(folder))
            for name, value in values.items():
                self._boards[shard].add_scalar(name, value, steps)

    def close(self) -> None:
        """Let go of the files."""
        if self._file is not None:
            self._file.close()
            self._file = None
        for board in self._boards.values():
            board.close()
        self._boards.clear()


def writer_class() -> Any:
    """TensorBoard's writer.

    Raises:
        StudyError: it is not installed.
    """
    return host.optional("tensorboardX", "--tensorboard", "tensorboard").SummaryWriter

"""The log of a run: JSON lines, one file per process; TensorBoard event files on request."""

import io
import json
import logging
import os
import socket
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

from uavmec_jax.files.extras import optional
from uavmec_jax.files.locations import is_local
from uavmec_jax.files.writing import write_text
from uavmec_jax.runs.file_names import TENSORBOARD

OnEvent = Callable[[str, dict[str, Any]], None]

CHUNK = "chunk"
"""The event that carries a shard's curves."""

_NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)


class RunLog:
    """Logs the events of one process that works on a run."""

    def __init__(
        self,
        folder: Path,
        *,
        tensorboard: bool = False,
        on_event: OnEvent = lambda event, facts: None,
        context: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        """Open the log.

        Args:
            folder: folder of the log files; created when the first event is logged.
            tensorboard: whether curves are also written as TensorBoard event files, beside the folder.
            on_event: called with every event and its facts.
            context: facts that are added to every event, such as the node.

        Raises:
            StudyError: ``tensorboard`` is set and tensorboardX is not installed.
        """
        self._logger = logging.Logger("uavmec_jax.run", logging.INFO)
        self._context = dict(context)
        name = f"{socket.gethostname()}-{os.getpid()}"
        if is_local(folder):
            self._logger.addHandler(_JsonLinesHandler(folder / f"{name}.jsonl"))
        else:  # objects cannot be appended to: each log is one that is written anew
            self._logger.addHandler(_JsonObjectHandler(folder / f"{name}-{time.time_ns():x}.jsonl"))
        if tensorboard and is_local(folder):  # TensorBoard's own writer knows paths only
            self._logger.addHandler(_TensorBoardHandler(folder.parent / TENSORBOARD))
        self._on_event = on_event

    def event(self, name: str, **facts: Any) -> None:
        """Log an event with its facts, which JSON must be able to hold."""
        facts |= self._context
        self._logger.info(name, extra={"facts": facts})
        self._on_event(name, facts)

    def curve(self, shard: int, steps: int, **values: float) -> None:
        """Log points of a shard's curves, at a number of environment steps of one agent."""
        self.event(CHUNK, shard=shard, steps=steps, **values)

    def close(self) -> None:
        """Close the files."""
        for handler in self._logger.handlers:
            handler.close()


class _JsonFormatter(logging.Formatter):
    """Formats an event as one JSON object: ``event``, ``at`` (seconds since the epoch) and the event's facts."""

    def format(self, record: logging.LogRecord) -> str:
        facts: dict[str, Any] = record.facts  # type: ignore[attr-defined]
        return json.dumps({"event": record.getMessage(), "at": round(record.created, 3)} | facts)


class _JsonLinesHandler(logging.FileHandler):
    """Appends lines to a file; while they cannot be written, they are dropped and the run goes on.

    The file is not buffered: a line that a full disk refuses is neither kept nor written again later.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, encoding="utf-8", delay=True)
        self.setFormatter(_JsonFormatter())

    def _open(self) -> Any:
        path = Path(self.baseFilename)
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | _NO_FOLLOW, 0o666)
        return io.TextIOWrapper(os.fdopen(descriptor, "ab", buffering=0), encoding=self.encoding, write_through=True)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 (the name is logging's)
        """Ignore a full disk: the run reports it when it writes its next checkpoint."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handleError(record)

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line; a folder that cannot be created is ignored like a full disk."""
        try:
            super().emit(record)
        except OSError:
            self.handleError(record)


class _JsonObjectHandler(logging.Handler):
    """Writes lines into one object of a store, all of them again every time; while that fails, the run goes on."""

    _EVERY_S = 30.0

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.setFormatter(_JsonFormatter())
        self._path = path
        self._lines: list[str] = []
        self._written = time.monotonic()

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a line, and write all of them if the last time was long ago."""
        self._lines.append(self.format(record) + "\n")
        if time.monotonic() - self._written > self._EVERY_S:
            self.flush()

    def flush(self) -> None:
        """Write all lines."""
        self._written = time.monotonic()
        with suppress(OSError):
            write_text(self._path, "".join(self._lines))

    def close(self) -> None:
        """Write all lines for the last time."""
        if self._lines:
            self.flush()
        super().close()


class _TensorBoardHandler(logging.Handler):
    """Writes curves as TensorBoard event files, one folder per shard."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._writers: dict[int, Any] = {}
        self._writer_class = tensorboard_writer()

    def emit(self, record: logging.LogRecord) -> None:
        """Add the scalars of a chunk."""
        if record.getMessage() != CHUNK:
            return
        facts: dict[str, Any] = dict(record.facts)  # type: ignore[attr-defined]
        shard, steps = facts.pop("shard"), facts.pop("steps")
        facts = {name: value for name, value in facts.items() if not isinstance(value, str)}  # the node is no curve
        if shard not in self._writers:
            self._writers[shard] = self._writer_class(str(self._folder / f"shard-{shard:05d}"))
        for name, value in facts.items():
            self._writers[shard].add_scalar(name, value, steps)

    def close(self) -> None:
        """Close the writers."""
        for writer in self._writers.values():
            writer.close()
        self._writers.clear()
        super().close()


def tensorboard_writer() -> Any:
    """Return TensorBoard's writer class.

    Raises:
        StudyError: it is not installed.
    """
    return optional("tensorboardX", "--tensorboard", "tensorboard").SummaryWriter

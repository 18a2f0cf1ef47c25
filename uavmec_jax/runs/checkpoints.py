"""Checkpoints of a shard in training: its whole state in a checked file; the previous checkpoint is kept too."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field

from uavmec_jax.errors import StudyError, UserError
from uavmec_jax.files.archives import open_checked, write_checked
from uavmec_jax.files.locations import is_local, names_in
from uavmec_jax.files.validation import StrictModel, validated
from uavmec_jax.files.writing import set_aside
from uavmec_jax.runs.file_names import CHECKPOINT, is_damaged, is_named
from uavmec_jax.runs.options import CheckpointKind
from uavmec_jax.scenarios.policy_files import PolicyCollection, write_policies
from uavmec_jax.training.training import Training

SCHEMA = 1
"""Version of the checkpoint file."""

_BYTES_PER_SECOND = 150e6
"""Assumed speed of writing, until a checkpoint has been timed."""

_KEPT = 2
"""Checkpoints of a shard that are kept."""


class _Progress(StrictModel):
    """What the header of a checkpoint says, besides what it belongs to."""

    model_config = ConfigDict(extra="ignore")

    chunks_done: Annotated[int, Field(ge=0)]
    seconds: dict[str, Annotated[float, Field(ge=0)]]


def interval_s(every_s: float, share: float, size: float, cost_s: float | None = None) -> float:
    """Return the seconds between two checkpoints.

    Args:
        every_s: the least.
        share: largest share of the time that writing may take.
        size: bytes of a checkpoint.
        cost_s: measured seconds of writing one; ``None`` before the first.
    """
    return max(every_s, (size / _BYTES_PER_SECOND if cost_s is None else cost_s) / share)


@dataclass
class Checkpoints:
    """The checkpoints of one shard.

    Attributes:
        folder: the shard's folder.
        kind: what a checkpoint holds.
        every_s: least seconds between two, by the monotonic clock.
        share: largest share of the time that writing may take.
        bytes: approximate size of one.
        identity: the run and the shard, which a checkpoint must name to be restored.
        attempt: name of the attempt at the shard that writes.
        log_event: called with ``(event, **facts)``.
        collect: turns weights into the policies that a ``weights`` checkpoint holds.
    """

    folder: Path
    kind: CheckpointKind
    every_s: float
    share: float
    bytes: int
    identity: dict[str, Any]
    attempt: str
    log_event: Callable[..., None]
    collect: Callable[[dict[str, Any]], PolicyCollection]
    _last: float = field(default_factory=time.monotonic)
    _cost_s: float | None = None

    @property
    def is_due(self) -> bool:
        """Whether enough time has passed since the last one."""
        return time.monotonic() - self._last >= interval_s(self.every_s, self.share, self.bytes, self._cost_s)

    def write(self, training: Training) -> None:
        """Save a training between two chunks, atomically, and remove the oldest checkpoints.

        Raises:
            OSError: the file cannot be written; earlier checkpoints are untouched.
        """
        started = time.monotonic()
        path = self.folder / f"{CHECKPOINT}-{training.chunks_done:06d}-{self.attempt}.npz"
        if self.kind == "weights":
            write_policies(path, self.collect(training.weights(self.identity["agents"])))
        else:
            progress = {"chunks_done": training.chunks_done, "steps": training.steps, "seconds": training.seconds}
            write_checked(path, SCHEMA, self.identity | progress, training.arrays(), compressed=False)
        size = path.stat().st_size
        for older in self._generations()[_KEPT:]:  # perhaps this one, if another attempt is further
            older.unlink(missing_ok=True)
        self._last = time.monotonic()
        self._cost_s = self._last - started
        training.seconds["checkpoint"] = training.seconds.get("checkpoint", 0.0) + self._cost_s
        self.log_event("checkpoint", file=path.name, steps=training.steps, bytes=size, seconds=self._cost_s)

    def resume(self, start: Callable[[], Training]) -> Training:
        """Resume from the newest intact checkpoint; without one, from the start.

        A damaged checkpoint is logged, renamed and skipped.
        """
        training = start()
        for path in self._generations() if self.kind == "full" else ():
            try:
                progress = self._restore(path, training)
            except StudyError as error:
                if isinstance(error.__cause__, OSError) and _is_file(path):
                    raise error.__cause__ from None  # the file server's fault, not the file's
                self.log_event("damaged", file=path.name, error=str(error))
                set_aside(path)
                training = start()
                continue
            for activity, spent in progress.seconds.items():
                training.seconds[activity] = training.seconds.get(activity, 0.0) + spent
            self.log_event("restored", file=path.name, steps=training.steps)
            break
        return training

    def _restore(self, path: Path, training: Training) -> _Progress:
        with open_checked(path, SCHEMA, "a checkpoint", StudyError) as (facts, arrays):
            if different := [name for name, value in self.identity.items() if facts.get(name) != value]:
                raise StudyError(f"{path}: belongs to another run: its {', '.join(different)} differ")
            progress = validated(_Progress, facts, path, StudyError)
            try:
                training.restore(progress.chunks_done, arrays)
            except UserError:
                raise
            except ValueError as error:
                raise StudyError(f"{path}: does not fit this shard: {error}") from None
        return progress

    def remove(self) -> None:
        """Remove all checkpoints, once the shard is finished."""
        for path in [*self._generations(), *self._files(lambda name: is_damaged(name) and name.startswith(CHECKPOINT))]:
            path.unlink(missing_ok=True)

    def _generations(self) -> list[Path]:
        """Return the checkpoints of all attempts, the furthest first: after as many chunks, all hold the same state."""
        return self._files(lambda name: is_named(name, CHECKPOINT))[::-1]

    def _files(self, is_wanted: Callable[[str], bool]) -> list[Path]:
        """Return the files of the shard with such names, sorted by name."""
        paths = [self.folder / name for name in names_in(self.folder) if is_wanted(name)]
        return [path for path in paths if not is_local(path) or path.is_symlink() or not path.is_dir()]


def _is_file(path: Path) -> bool:
    """Return whether there is a regular file; what is in its place (a pipe, a link to nowhere) is nobody's checkpoint."""
    return path.is_file() if is_local(path) else path.exists()

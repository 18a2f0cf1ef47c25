"""Snapshots of a shard in training: the whole state, checked, the one before kept."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from uavmec_jax.errors import StudyError
from uavmec_jax.files.archives import open_checked, write_checked
from uavmec_jax.scenarios.policy_files import Collection, write_collection
from uavmec_jax.training.training import Training

SCHEMA = 1
"""Version of a snapshot's file."""

Kind = Literal["full", "weights"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""``full``: everything, a shard goes on from there. ``weights``: policies as they are by now, small; a shard that was
stopped is trained again from its start."""

INTERVAL_S = 60.0
"""Least time between two snapshots."""

SHARE = 0.02
"""Most of the time that snapshots may take."""

_BYTES_PER_SECOND = 150e6
"""How fast the first one is thought to be written."""

_KEPT = 2
"""Generations."""


def interval_s(every_s: float, share: float, size: float, cost_s: float | None = None) -> float:
    """Seconds between two snapshots of ``size`` bytes; ``cost_s`` is what one is known to take."""
    return max(every_s, (size / _BYTES_PER_SECOND if cost_s is None else cost_s) / share)


@dataclass
class Snapshots:
    """The snapshots of one shard.

    Attributes:
        folder: of the shard.
        kind: what is kept.
        every_s: least time between two, by the monotonic clock.
        share: most of the time that they may take.
        bytes: size of one, about.
        facts: what the snapshots must be of: the plan and the shard.
        tell: told ``(event, facts)``.
        collection: makes the policies of a ``weights`` snapshot.
    """

    folder: Path
    kind: Kind
    every_s: float
    share: float
    bytes: int
    facts: dict[str, Any]
    tell: Callable[..., None]
    collection: Callable[[dict[str, Any]], Collection]
    _last: float = field(default_factory=time.monotonic)
    _cost_s: float | None = None

    @property
    def is_due(self) -> bool:
        """Whether it is time: the interval is over, and the cost is a small share of the time since the last one."""
        return time.monotonic() - self._last >= interval_s(self.every_s, self.share, self.bytes, self._cost_s)

    def write(self, training: Training) -> None:
        """Keep a training as it is between two chunks, whole or not at all; older generations go afterwards.

        Raises:
            OSError: it cannot be written; those before it are as they were.
        """
        tick = time.monotonic()
        path = self._next_path()
        if self.kind == "weights":
            write_collection(path, self.collection(training.weights(self.facts["agents"])))
        else:
            facts = self.facts | {"done": training.done, "steps": training.steps, "seconds": training.seconds}
            write_checked(path, SCHEMA, facts, training.arrays(), compressed=False)
        for older in self._generations()[_KEPT:]:
            older.unlink(missing_ok=True)
        self._last = time.monotonic()
        self._cost_s = self._last - tick
        training.seconds["snapshot"] = training.seconds.get("snapshot", 0.0) + self._cost_s
        self.tell("snapshot", file=path.name, steps=training.steps, bytes=path.stat().st_size, seconds=self._cost_s)

    def resume(self, start: Callable[[], Training]) -> Training:
        """A training that goes on from the newest snapshot that is sound, or from the start.

        A snapshot that is damaged is named, set aside and passed over.
        """
        training = start()
        for path in self._generations() if self.kind == "full" else ():
            try:
                with open_checked(path, SCHEMA, "a snapshot", StudyError) as (facts, arrays):
                    if strange := [name for name, value in self.facts.items() if facts.get(name) != value]:
                        raise StudyError(f"{path}: is of another run: its {', '.join(strange)} differ")
                    training.restore(facts["done"], arrays)
            except StudyError as error:
                self.tell("damaged", file=path.name, error=str(error))
                path.rename(path.with_suffix(".damaged"))
                training = start()
                continue
            for activity, spent in facts["seconds"].items():
                training.seconds[activity] = training.seconds.get(activity, 0.0) + spent
            self.tell("restored", file=path.name, steps=training.steps)
            break
        return training

    def remove(self) -> None:
        """The shard is finished: none is needed."""
        for path in [*self._generations(), *self.folder.glob("snapshot-*.damaged")]:
            path.unlink(missing_ok=True)

    def _next_path(self) -> Path:
        numbers = [int(path.stem.removeprefix("snapshot-")) for path in self.folder.glob("snapshot-[0-9]*.*")]
        return self.folder / f"snapshot-{max(numbers, default=0) + 1:06d}.npz"

    def _generations(self) -> list[Path]:
        """The newest first."""
        return sorted(self.folder.glob("snapshot-*.npz"), reverse=True)

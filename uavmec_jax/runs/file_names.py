"""The names that a run gives its files, and by which it tells its own from strangers.

Whatever else lies among the shards (a copy that a synchronised folder has made, the notes of a file manager) is not read.
"""

import re

RUN_PLAN, LOG, SHARDS, TENSORBOARD, TOUR = "run_plan.json", "log", "shards", "tensorboard", "tour.json"
CHECKPOINT, PROGRESS, RESULT, FAILURE = "checkpoint", "progress", "result", "failed.json"
"""What an attempt at a shard writes, under its own name, and why the shard failed."""

_ATTEMPT = r"[0-9]{2,}-[0-9a-f]{6}"
"""The name of an attempt, see :meth:`RunFolder.new_attempt`."""

_PATTERNS = {
    CHECKPOINT: re.compile(rf"{CHECKPOINT}-[0-9]{{6,}}-{_ATTEMPT}\.npz"),
    PROGRESS: re.compile(rf"{PROGRESS}-{_ATTEMPT}\.json"),
    RESULT: re.compile(rf"{RESULT}-{_ATTEMPT}\.npz"),
    FAILURE: re.compile(re.escape(FAILURE)),
}
_DAMAGED = re.compile(rf"({CHECKPOINT}-[0-9]{{6,}}|{RESULT})-{_ATTEMPT}\.damaged")
_PARTIAL = re.compile(r"\..+-[0-9a-f]{16}\.part\.[a-z]+")
"""A file that :func:`uavmec_jax.files.writing.atomic` was writing when its process was killed."""


def is_named(name: str, kind: str) -> bool:
    """Return whether a run gives this name to files of a kind: ``CHECKPOINT``, ``PROGRESS``, ``RESULT`` or ``FAILURE``."""
    return _PATTERNS[kind].fullmatch(name) is not None


def is_damaged(name: str) -> bool:
    """Return whether this is the name of a damaged file of a shard that was set aside."""
    return _DAMAGED.fullmatch(name) is not None


def is_partial(name: str) -> bool:
    """Return whether this is the name of a file that is being written."""
    return _PARTIAL.fullmatch(name) is not None


def is_ours(name: str) -> bool:
    """Return whether a run gives this name to anything in the folder of a shard."""
    return any(is_named(name, kind) for kind in _PATTERNS) or is_damaged(name) or is_partial(name)

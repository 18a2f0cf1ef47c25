"""The folders that commands write: one command at a time in each, and nothing that is there is overwritten."""

import itertools
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from uavmec_jax.errors import StudyError
from uavmec_jax.files.locations import is_local, names_in, reached, remove_folder
from uavmec_jax.files.locks import LOCK, OWNER, in_use, lock_folder, owner_of, this_machine

WORK = "shards"
"""Folder inside an output folder that is there while a command writes: its lock, and a run's unfinished shards."""

_RUN = "a run; resume it with `uavmec resume`, or"
_SEARCH = "a search; continue it with `uavmec search`, or"

KINDS = {
    "run_plan.json": _RUN,
    "run.json": _RUN,
    "study.toml": _RUN,
    "tour.json": "a tour of `uavmec plan`;",
    "search.json": _SEARCH,
    "trials.db": _SEARCH,
}
"""Files by which a folder shows what it holds, and what can be done with that."""


def create_new_folder(parent: Path, name: str) -> Path:
    """Create a folder that nobody else has; a number is added to a name that is taken.

    Raises:
        OSError: the folder cannot be created.
    """
    parent.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        folder = parent / (name if number == 1 else f"{name}-{number}")
        with suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise AssertionError("there are endless numbers")


def check_directory(folder: Path) -> None:
    """Refuse a folder that a command cannot write its results to.

    Raises:
        StudyError: it is not empty, another process works in it, it is a file, or its object store cannot be reached.
    """
    with reached(folder):
        if (owner := owner_of(folder / WORK)) is not None:
            elsewhere = owner.get("machine") != this_machine()
            raise in_use(folder, owner, f"; {_free(folder)}" if elsewhere and _kind(folder) is None else "")
        check_empty(folder)


def check_empty(folder: Path) -> None:
    """Refuse a folder that holds anything but a lock.

    Raises:
        StudyError: it says what the folder holds, or that it is a file.
    """
    if (kind := _kind(folder)) is not None:
        raise StudyError(f"{folder}: already holds {kind} give another folder with --out")
    unused = set(names_in(folder)) <= {WORK} and set(names_in(folder / WORK)) <= {LOCK, OWNER}
    if folder.exists() and not (folder.is_dir() and unused):
        raise StudyError(f"{folder}: exists and is not an empty folder; give another one with --out")


def _kind(folder: Path) -> str | None:
    """Return what a folder holds, and what can be done with that; ``None`` if it shows nothing of ours."""
    return next((kind for name, kind in KINDS.items() if (folder / name).exists()), None)


def _free(folder: Path) -> str:
    """Return how to free a folder whose lock is all that it holds."""
    return f"if that process is dead, remove {folder / WORK}"


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Hold an empty folder of this machine, which is created if it is missing, while its files are written.

    If nothing is written, a folder that was created is removed again.

    Raises:
        StudyError: it holds something, or another process works in it.
        OSError: it cannot be written to.
    """
    existed = folder.exists()
    check_directory(folder)
    try:
        with lock_folder(folder / WORK, folder, if_dead=_free(folder)):
            check_empty(folder)  # whoever held the lock may have written
            try:
                yield
            finally:
                remove_folder(folder / WORK)
    finally:
        if not existed:
            remove_if_empty(folder)


def remove_if_empty(folder: Path) -> None:
    """Remove a folder that nothing was written to."""
    if is_local(folder):
        with suppress(OSError):
            folder.rmdir()

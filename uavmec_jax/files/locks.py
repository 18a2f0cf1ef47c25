"""One process at a time in a folder.

On a file system that has them, an advisory lock of the operating system decides: it ends with its process. The file
``owner.json`` beside it names the owner in messages, and stands in for the lock where machines share a folder or it is in
an object store: it is created exclusively, and stays if its owner's machine dies, until somebody takes the folder over.
Results never depend on either: all writes are atomic, and two processes would write the same.
"""

import json
import os
import secrets
import socket
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
from filelock import FileLock, Timeout

from uavmec_jax.errors import StudyError
from uavmec_jax.files.locations import check_no_link, is_local, make_folder, store_errors
from uavmec_jax.files.reading import read_json_or_empty
from uavmec_jax.files.writing import create_exclusively

LOCK, OWNER = "lock", "owner.json"


def this_machine() -> str:
    """Return the host name and the identity of the running system, since several machines may share a name."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        boot = f"{uuid.getnode():x}"
    return f"{socket.gethostname()} {boot}"


def this_process() -> dict[str, Any]:
    """Return what identifies this process among those of all machines, and the time."""
    pid = os.getpid()
    return {"machine": this_machine(), "pid": pid, "born": _born(pid), "at": time.time()}


def describe_process(process: dict[str, Any]) -> str:
    """Return a process in words."""
    machine = str(process.get("machine") or "").split() or ["an unknown machine"]
    return f"process {process.get('pid', '?')} on {machine[0]}"


def is_known_dead(process: dict[str, Any]) -> bool:
    """Return whether a process was one of this machine that has ended; its number may have been reused."""
    if process.get("machine") != this_machine():
        return False
    pid = process.get("pid")
    if type(pid) is not int or not 0 < pid < 2**31:  # not written by this package
        return True
    return not psutil.pid_exists(pid) or process.get("born") != _born(pid)


def owner_of(folder: Path) -> dict[str, Any] | None:
    """Return the process that holds the lock on a folder as far as can be told without trying; ``None`` if there is none."""
    owner = read_json_or_empty(folder / OWNER)
    return owner if owner and not is_known_dead(owner) else None


def in_use(of: Path, owner: dict[str, Any], more: str = "") -> StudyError:
    """Return the error that names who works in a folder."""
    return StudyError(f"{of}: {describe_process(owner)} is working in it{more}")


@contextmanager
def lock_folder(
    folder: Path, of: Path, *, take_over: bool = False, if_dead: str = "if that process is dead, give --take-over"
) -> Iterator[None]:
    """Hold the lock on a folder, which is created if it is missing.

    Args:
        folder: the folder.
        of: what the message names in place of the folder.
        take_over: whether to replace an owner on another machine, which may be dead.
        if_dead: what the message says is to be done about such an owner.

    Raises:
        StudyError: another process holds it, or the folder is a symbolic link.
        OSError: the folder cannot be written to.
    """
    check_no_link(folder)
    make_folder(folder)
    lock = _acquire(folder, of)
    try:
        token = _become_owner(folder, of, take_over, if_dead, locked=lock is not None)
        try:
            yield
        finally:
            _resign(folder / OWNER, token)
    finally:
        if lock is not None:
            lock.release()


def _acquire(folder: Path, of: Path) -> FileLock | None:
    """Acquire the advisory lock; return ``None`` where there are no such locks."""
    if not is_local(folder):
        return None
    lock = FileLock(folder / LOCK, blocking=False, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout:
        raise in_use(of, read_json_or_empty(folder / OWNER)) from None
    except NotImplementedError:
        return None
    return lock


def _become_owner(folder: Path, of: Path, take_over: bool, if_dead: str, *, locked: bool) -> str:
    """Create the owner's file, which holds the token that is returned."""
    path, token = folder / OWNER, secrets.token_hex(8)
    if path.exists():
        owner = read_json_or_empty(path)
        here = not owner or owner.get("machine") == this_machine()
        free = take_over or is_known_dead(owner) or (locked and here)
        if not free:
            raise in_use(of, owner, f"; {if_dead}")
        path.unlink(missing_ok=True)
    if not create_exclusively(path, json.dumps(this_process() | {"token": token}).encode()):
        owner = read_json_or_empty(path)
        if owner.get("token") != token:  # a store may answer so to a request that it was sent twice
            raise in_use(of, owner)
    return token


def _resign(path: Path, token: str) -> None:
    """Remove the owner's file if it still holds the token; if it stays, it names a process that has ended."""
    with suppress(OSError), store_errors():
        if read_json_or_empty(path).get("token") == token:
            path.unlink(missing_ok=True)


def _born(pid: int) -> str | None:
    """Return when a process started, in ticks since the machine did, which no clock changes; ``None`` if not on Linux."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return None

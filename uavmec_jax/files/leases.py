"""Leases on the parts of a folder that several processes and hosts share.

A lease is a numbered file. To claim it, a process creates the next number, which only one process can; the highest number
holds. The holder writes a heartbeat into its file every few seconds. Others take over when the holder is known to be dead
(its process has ended on this machine), when it has released the lease, or when it is stale: they have seen no new
heartbeat for the length of the lease by their own monotonic clock, so clocks that differ or jump do no harm. A holder that
was only suspended finds a higher number and stops (Gray and Cheriton, 1989; the number is a fencing token).
"""

import json
import os
import socket
import threading
import time
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from uavmec_jax.errors import StudyError
from uavmec_jax.files.reading import read_json_or_empty
from uavmec_jax.files.writing import atomic

LEASE_S = 60.0
"""Seconds without a heartbeat after which a holder on another machine is stale."""

_HEARTBEATS_PER_LEASE = 6


class LeaseLostError(StudyError):
    """Another process has taken over the lease."""


def this_machine() -> str:
    """Return the host name and the identity of the running system, since several machines may share a name."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        boot = f"{uuid.getnode():x}"
    return f"{socket.gethostname()} {boot}"


def describe_holder(holder: dict[str, Any]) -> str:
    """Return a holder in words."""
    return f"process {holder.get('pid', '?')} on {str(holder.get('machine', 'an unknown machine')).split()[0]}"


@dataclass
class Lease:
    """A lease that this process holds; a thread writes its heartbeats.

    Attributes:
        folder: the folder that is claimed.
        number: the number of the claim.
        lease_s: seconds without a heartbeat after which the lease is stale.
        progress: what each heartbeat reports in addition, such as steps.
    """

    folder: Path
    number: int
    lease_s: float
    progress: dict[str, Any] = field(default_factory=dict)
    _heartbeats: int = 0
    _ended: threading.Event = field(default_factory=threading.Event)
    _writing: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        self._thread = threading.Thread(target=self._write_heartbeats, daemon=True, name=f"lease {self.folder.name}")
        self._thread.start()

    @property
    def path(self) -> Path:
        """The file of the lease."""
        return _file(self.folder, self.number)

    def check(self) -> None:
        """Check that this process still holds the lease.

        Raises:
            LeaseLostError: another process has taken over.
        """
        if _file(self.folder, self.number + 1).exists() or not self.path.exists():
            raise LeaseLostError(f"{self.folder}: {describe_holder(read_lease(self.folder))} has taken over")

    def release(self) -> None:
        """Release the lease, so that the next process need not wait."""
        self._ended.set()
        self._thread.join()
        self._write(released=True)

    def _write_heartbeats(self) -> None:
        while not self._ended.wait(self.lease_s / _HEARTBEATS_PER_LEASE):
            self._write()

    def _write(self, **fields: Any) -> None:
        with self._writing:
            self._heartbeats += 1
            text = json.dumps(_identity() | {"heartbeat": self._heartbeats} | self.progress | fields)
            try:
                with atomic(self.path) as partial:
                    partial.write_text(text, encoding="utf-8")
            except OSError:  # full disk, file server gone: others may take over, which `check` then reports
                return


class Leases:
    """Claims leases and remembers the heartbeats of other holders."""

    def __init__(self, lease_s: float = LEASE_S) -> None:
        self.lease_s = lease_s
        self._seen: dict[Path, tuple[bytes, float]] = {}

    def claim(self, folder: Path) -> Lease | None:
        """Claim a folder; return ``None`` if another process holds it."""
        latest = _latest(folder)
        if latest and self.holder(folder) is not None:
            return None
        folder.mkdir(parents=True, exist_ok=True)
        try:
            with _file(folder, latest + 1).open("x", encoding="utf-8") as file:
                file.write(json.dumps(_identity() | {"heartbeat": 0}))
        except FileExistsError:
            return None
        return Lease(folder, latest + 1, self.lease_s)

    def holder(self, folder: Path) -> dict[str, Any] | None:
        """Return the holder of a folder as far as this process can tell, ``None`` if there is none."""
        latest = _latest(folder)
        if not latest:
            return None
        path = _file(folder, latest)
        try:
            content = path.read_bytes()
        except OSError:
            content = b""
        now = time.monotonic()
        before, since = self._seen.get(path, (None, now))
        if content != before:
            self._seen[path] = (content, now)
            since = now
        holder = read_json_or_empty(path)
        dead = _is_known_dead(holder) or holder.get("released") or now - since > self.lease_s
        return None if dead else holder

    def hold(self, folder: Path, of: Path, more: str = "") -> Lease:
        """Claim a folder or fail; wait if its holder is on another machine and may be dead.

        Args:
            folder: the folder to claim.
            of: what the message names in place of the folder.
            more: added to the end of the message.

        Raises:
            StudyError: another process holds the folder and is alive.
        """
        first: dict[str, Any] | None = None
        while (lease := self.claim(folder)) is None:
            holder = self.holder(folder)
            if holder is None:
                continue
            first = holder if first is None else first
            if holder.get("machine") == this_machine() or holder.get("heartbeat") != first.get("heartbeat"):
                raise StudyError(f"{of}: {describe_holder(holder)} is working in it{more}")
            time.sleep(min(1.0, self.lease_s / 4))
        return lease

    def taken_over(self, folder: Path) -> bool:
        """Return whether the folder has been claimed before."""
        return _latest(folder) > 0


def _is_known_dead(holder: dict[str, Any]) -> bool:
    """Return whether the holder was a process of this machine that has ended; its number may have been reused."""
    if holder.get("machine") != this_machine():
        return False
    pid = holder.get("pid", -1)
    return not psutil.pid_exists(pid) or holder.get("born") != _born(pid)


def _born(pid: int) -> str | None:
    """Return when a process started, in ticks since the machine did, which no clock changes; ``None`` if not on Linux."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return None


def _identity() -> dict[str, Any]:
    pid = os.getpid()
    return {"machine": this_machine(), "pid": pid, "born": _born(pid), "at": time.time()}


def _file(folder: Path, number: int) -> Path:
    return folder / f"lease-{number:04d}.json"


def _latest(folder: Path) -> int:
    """Return the number of the latest claim, 0 if there is none."""
    return max((int(path.stem.removeprefix("lease-")) for path in folder.glob("lease-[0-9]*.json")), default=0)


def read_lease(folder: Path) -> dict[str, Any]:
    """Read the file of the latest claim, whether it still holds or not; empty if there is none."""
    latest = _latest(folder)
    return read_json_or_empty(_file(folder, latest)) if latest else {}


def is_stale(lease: dict[str, Any], lease_s: float) -> bool:
    """Return whether the holder has ended or is stale by the clocks of both machines; for display only."""
    return bool(_is_known_dead(lease) or lease.get("released") or time.time() - lease.get("at", 0) > lease_s)

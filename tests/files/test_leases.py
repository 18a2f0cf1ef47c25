"""Leases: one holder at a time whatever the clocks say; dead holders lose the lease, suspended ones notice."""

import json
import threading
import time

import pytest

from uavmec_jax.errors import StudyError
from uavmec_jax.files import leases as module
from uavmec_jax.files.leases import LeaseLostError, Leases, is_stale, read_lease

pytestmark = pytest.mark.slow

QUICK = 0.8


def move_elsewhere(lease):
    """Make a lease look like that of a process on another machine, which has died."""
    lease._ended.set()
    lease._thread.join()
    content = json.loads(lease.path.read_text())
    lease.path.write_text(json.dumps(content | {"machine": "other 0123", "pid": 7}))


def test_one_process_holds_it_until_it_releases_it(tmp_path):
    mine, other = Leases(), Leases()
    lease = mine.claim(tmp_path / "shard")
    assert other.claim(tmp_path / "shard") is None
    with pytest.raises(StudyError, match=r"shard: process \d+ on .* is working in it; to help, call"):
        other.hold(tmp_path / "shard", tmp_path / "shard", "; to help, call")
    lease.check()
    lease.release()
    again = other.claim(tmp_path / "shard")
    assert again.number == 2
    with pytest.raises(LeaseLostError, match="has taken over"):
        lease.check()
    again.release()


def test_one_of_many_concurrent_claims_succeeds(tmp_path):
    leases, ready = [], threading.Barrier(8)

    def claim():
        ready.wait()
        leases.append(Leases().claim(tmp_path / "shard"))

    threads = [threading.Thread(target=claim) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (winner,) = [lease for lease in leases if lease is not None]
    winner.release()


def test_a_process_that_has_ended_on_this_machine_loses_it_at_once(tmp_path, monkeypatch):
    lease = Leases().claim(tmp_path)
    assert Leases().claim(tmp_path) is None
    monkeypatch.setattr(module.psutil, "pid_exists", lambda pid: False)
    assert Leases().claim(tmp_path).number == 2
    lease.release()


def test_a_reused_process_number_is_no_holder(tmp_path, monkeypatch):
    lease = Leases().claim(tmp_path)
    monkeypatch.setattr(module, "_born", lambda pid: "another")
    assert Leases().claim(tmp_path).number == 2
    lease.release()


def test_a_holder_on_another_machine_is_stale_after_a_whole_lease_without_a_heartbeat(tmp_path):
    lease = Leases(QUICK).claim(tmp_path)
    move_elsewhere(lease)
    other = Leases(QUICK)
    assert other.claim(tmp_path) is None  # seen for the first time: it may be alive
    time.sleep(QUICK / 2)
    assert other.claim(tmp_path) is None
    time.sleep(QUICK)
    assert other.claim(tmp_path).number == 2


def test_hold_waits_for_a_heartbeat(tmp_path):
    lease = Leases(QUICK).claim(tmp_path)
    move_elsewhere(lease)
    assert Leases(QUICK).hold(tmp_path, tmp_path).number == 2


def test_heartbeats_keep_it(tmp_path):
    lease = Leases(QUICK).claim(tmp_path)
    lease.progress["steps"] = 5
    other = Leases(QUICK)
    deadline = time.monotonic() + 3 * QUICK
    while time.monotonic() < deadline:
        assert other.claim(tmp_path) is None
        time.sleep(QUICK / 10)
    assert read_lease(tmp_path)["steps"] == 5
    lease.release()


@pytest.mark.parametrize("jump", [-1e6, 1e6])
def test_a_clock_that_jumps_changes_nothing(tmp_path, monkeypatch, jump):
    lease = Leases(QUICK).claim(tmp_path)
    other = Leases(QUICK)
    assert other.claim(tmp_path) is None
    now = time.time
    monkeypatch.setattr(module.time, "time", lambda: now() + jump)
    time.sleep(QUICK / 2)
    assert other.claim(tmp_path) is None
    lease.check()
    move_elsewhere(lease)
    assert other.claim(tmp_path) is None
    time.sleep(1.2 * QUICK)
    assert other.claim(tmp_path).number == 2


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff\xfe"])
def test_a_damaged_lease_holds_until_it_is_stale(tmp_path, content):
    (tmp_path / "lease-0003.json").write_bytes(content)
    other = Leases(QUICK)
    assert other.claim(tmp_path) is None
    time.sleep(1.2 * QUICK)
    assert other.claim(tmp_path).number == 4


def test_is_stale_after_the_release(tmp_path):
    lease = Leases().claim(tmp_path)
    assert not is_stale(read_lease(tmp_path), 60)
    lease.release()
    assert is_stale(read_lease(tmp_path), 60)
    assert read_lease(tmp_path / "nothing") == {}

"""`uavmec run --ray` from the command line: stopped, killed, and left alone by the head of its cluster."""

import json
import signal
import time

import psutil
import pytest

from tests.clusters import CPUS, FORK, simulated_cluster
from tests.runs.processes import TINY, bits, events, start, uavmec
from uavmec_jax.runs.run import run_study
from uavmec_jax.runs.status import run_status
from uavmec_jax.studies.study import parse_study

pytestmark = [pytest.mark.ray, pytest.mark.filterwarnings(FORK)]

OPTIONS = ["--set", "steps=150000", "--shard-size", "2", "--checkpoint-every", "0", "--checkpoint-share", "0.5"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    directory = tmp_path_factory.mktemp("whole") / "run"
    run_study(parse_study(TINY, "tiny", {"steps": 150_000}), directory, shard_size=2, command="x")
    return directory


def test_the_head_dies_and_the_run_goes_on_without_it(whole, tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    with simulated_cluster(1) as nodes:
        head = nodes.address
        on_ray = ["--cpus-per-shard", CPUS, "--ray", head]
        process = start("run", "tiny.toml", *OPTIONS, "--out", "run", *on_ray, cwd=tmp_path)
        wait_for(lambda: events(tmp_path / "run", "checkpoint"), process)
        nodes.head_node.all_processes["gcs_server"][0].process.kill()
        _, errors = process.communicate(timeout=120)
    assert process.returncode == 2, errors
    assert errors.splitlines()[-1] == (
        f"uavmec: the head of the Ray cluster, {head}, does not answer any more; resume with: uavmec resume run"
    )
    uavmec("resume", "run", cwd=tmp_path)
    assert bits(tmp_path / "run") == bits(whole)


def test_the_command_starts_ray_is_stopped_and_killed_and_the_run_goes_on(whole, tmp_path):
    """From the command line, with a Ray of its own each time: SIGTERM saves the shards, SIGKILL loses a little."""
    (tmp_path / "tiny.toml").write_text(TINY)
    process = start("run", "tiny.toml", *OPTIONS, "--out", "run", "--ray", cwd=tmp_path)
    wait_for(lambda: events(tmp_path / "run", "chunk"), process)
    shown = json.loads(uavmec("status", "run", "--json", cwd=tmp_path).stdout)
    assert list(shown["nodes"].values()) == [1]
    assert shown["owner"].startswith(f"process {process.pid} on ")
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 143, errors
    assert "resume with: uavmec resume run" in errors
    assert run_status(tmp_path / "run").shards["stopped"] == 1
    process = start("resume", "run", "--ray", "local", cwd=tmp_path)
    wait_for(lambda: len(events(tmp_path / "run", "started")) >= 2, process)
    process.kill()
    process.communicate()
    wait_for_the_end_of_ray()
    uavmec("resume", "run", cwd=tmp_path)
    assert bits(tmp_path / "run") == bits(whole)


def wait_for(condition, process, seconds=120):
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "took too long"
        time.sleep(0.05)


def wait_for_the_end_of_ray(seconds=60):
    """Wait until no process of a killed driver works on: Ray ends them when it misses the driver."""
    deadline = time.monotonic() + seconds
    while any("ray::shard-" in " ".join(process.cmdline()) for process in psutil.process_iter() if _alive(process)):
        assert time.monotonic() < deadline
        time.sleep(0.2)


def _alive(process):
    try:
        return process.status() != psutil.STATUS_ZOMBIE and process.cmdline()
    except psutil.Error:
        return False

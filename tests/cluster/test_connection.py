"""Starting and joining Ray: bad addresses, tokens, what this machine can take, and no open port."""

import subprocess
import sys

import pytest

from tests.runs.processes import environment
from uavmec_jax.cluster.connection import connect
from uavmec_jax.cluster.options import RayOptions
from uavmec_jax.errors import StudyError

START = """
import os
import psutil
from uavmec_jax.cluster.connection import connect
from uavmec_jax.cluster.options import RayOptions
with connect(RayOptions()) as cluster:
    print(cluster.slots(), os.environ["RAY_AUTH_MODE"], len(cluster.nodes()))
    here = psutil.Process()
    processes = [here, *here.children(recursive=True)]
    for process in processes:
        for connection in process.net_connections(kind="inet"):
            if connection.status == psutil.CONN_LISTEN:
                print("open", process.name(), connection.laddr.ip)
"""


@pytest.mark.parametrize("address", ["table5", "http://x:1", "host", ":1", "host:port", "a b:1"])
def test_what_is_no_address_is_refused_before_ray_is_imported(address):
    with pytest.raises(StudyError, match="is not the address of a Ray cluster"), connect(RayOptions(address=address)):
        pass
    assert "ray" not in sys.modules


@pytest.mark.parametrize("mode", ["variable", "file"])
def test_a_token_that_is_asked_for_and_missing_is_named(monkeypatch, tmp_path, mode):
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.delenv("RAY_AUTH_TOKEN", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    if mode == "file":
        monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "nowhere"))
    with (
        pytest.raises(StudyError, match="RAY_AUTH_MODE is token and there is no token: set RAY_AUTH_TOKEN"),
        connect(RayOptions(address="127.0.0.1:1")),
    ):
        pass


@pytest.mark.ray
def test_a_local_ray_has_a_token_and_listens_on_the_loopback_interface_alone():
    done = started("RayOptions()")
    assert done.returncode == 0, done.stderr
    first, *ports = done.stdout.splitlines()
    assert first == "1 token 1"
    assert len(ports) >= 3
    assert [line for line in ports if not line.endswith(("127.0.0.1", "::1", "::ffff:127.0.0.1"))] == []


@pytest.mark.ray
def test_what_this_machine_cannot_take_is_refused():
    done = started("RayOptions(cpus_per_shard=4096)")
    assert "--ray local: this machine cannot take a shard, which needs CPU 4096 (largest node: 2)" in done.stderr


@pytest.mark.ray
def test_nobody_answers():
    done = started("RayOptions(address='127.0.0.1:1')")
    assert "--ray 127.0.0.1:1: cannot reach a Ray cluster at this address" in done.stderr


def started(options):
    """Start Ray with some options in a process of its own, in an environment that says nothing about Ray."""
    variables = {name: value for name, value in environment().items() if not name.startswith("RAY_")}
    command = [sys.executable, "-c", START.replace("RayOptions()", options)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=variables)

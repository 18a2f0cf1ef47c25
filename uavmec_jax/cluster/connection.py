"""Start Ray on this machine, or join a cluster."""

import os
import re
import secrets
import socket
import sys
from collections.abc import Iterator
from contextlib import chdir, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from uavmec_jax.cluster.local import local_cluster
from uavmec_jax.cluster.options import LOCAL, RayOptions
from uavmec_jax.errors import StudyError
from uavmec_jax.files.extras import optional

_ADDRESS = re.compile(r"auto|local|(ray://)?[^/\s:]+:\d+|(ray://)?\[[0-9a-fA-F:]+\]:\d+")

_ANSWER_S = 10.0
"""Seconds in which a cluster must answer."""

_QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # else Ray warns of a change to come
    # Under `uv run`, Ray would copy the working folder to every node and run its workers by the same command there.
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
}
"""What Ray reads when it is imported; what the user has set stays."""


_ON_NETWORK = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""Ray's variable that keeps a cluster on the loopback interface if it is 0, in spite of its name on Linux too; else Ray
listens on the machine's outer address, whatever address it is given."""

_TOKEN_FILE = "RAY_AUTH_TOKEN_PATH"
"""Ray's variable that names a file with the token."""


@dataclass(frozen=True)
class Cluster:
    """A cluster that this process is connected to.

    Attributes:
        ray: the module ``ray``.
        options: what each shard needs.
        head: address of the head's store, which Ray needs for everything; empty where Ray does not tell it.
    """

    ray: Any
    options: RayOptions
    head: str = ""

    @property
    def requirements(self) -> dict[str, Any]:
        """What a shard needs, as Ray's task options."""
        gpus, resources = self.options.gpus_per_shard, dict(self.options.resources)
        return {"num_cpus": cpus_per_shard(self.options), "num_gpus": gpus, "resources": resources or None}

    def nodes(self) -> list[dict[str, Any]]:
        """Return the nodes that are alive, as Ray describes them."""
        return [node for node in self.ray.nodes() if node["Alive"]]

    @property
    def _needed(self) -> dict[str, float]:
        needed = {"CPU": cpus_per_shard(self.options), "GPU": self.options.gpus_per_shard, **self.options.resources}
        return {name: amount for name, amount in needed.items() if amount}

    def slots(self) -> int:
        """Return how many shards the present nodes can take at the same time."""
        return sum(
            int(min(node["Resources"].get(name, 0.0) // amount for name, amount in self._needed.items()))
            for node in self.nodes()
        )

    def shortage(self) -> str:
        """Return what a shard needs and the nodes have, in words."""
        most = {name: max((n["Resources"].get(name, 0.0) for n in self.nodes()), default=0.0) for name in self._needed}
        return ", ".join(f"{name} {amount:g} (largest node: {most[name]:g})" for name, amount in self._needed.items())

    def answers(self) -> bool:
        """Return whether the head of the cluster can be reached."""
        return not self.head or _listens(*_host_and_port(self.head))


def cpus_per_shard(options: RayOptions) -> int:
    """Return the cores of a shard: those asked for, else this machine's, else one beside a GPU."""
    return options.cpus_per_shard or (1 if options.gpus_per_shard else n_cores())


def devices_per_shard(options: RayOptions) -> int:
    """Return the JAX devices of a shard: its GPUs, or if it has none, its cores."""
    return options.gpus_per_shard or cpus_per_shard(options)


def n_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def connect(options: RayOptions) -> Iterator[Cluster]:
    """Start or join a cluster; leave it afterwards, and end it if it was started here.

    A process that Ray already runs in keeps its cluster.

    Raises:
        StudyError: Ray is not installed, the address is none or nobody answers there, there is no token although the
            cluster asks for one, or no node of a cluster that was started here can take a shard.
    """
    address = options.address or os.environ.get("RAY_ADDRESS") or LOCAL
    if not _ADDRESS.fullmatch(address):
        raise StudyError(
            f"--ray {address}: is not the address of a Ray cluster; give host:port, ray://host:port, auto or local"
        )
    if (running := _running_ray()) is not None:
        cluster = Cluster(running, options, _head(running))
        if ":" in address and "://" not in address and address != cluster.head:
            raise StudyError(
                f"--ray {address}: Ray already runs in this process, at {cluster.head}; leave out the address"
            )
        yield cluster
        return
    prepare_environment(address)
    ray = optional("ray", "--ray", "ray")
    with local_cluster(n_cores()) if address == LOCAL else nullcontext(address) as joined:
        _init(ray, joined)
        try:
            cluster = Cluster(ray, options, _head(ray))
            if address == LOCAL and not cluster.slots():
                raise StudyError(f"--ray local: this machine cannot take a shard, which needs {cluster.shortage()}")
            yield cluster
        finally:
            ray.shutdown()


@contextmanager
def connected(options: RayOptions | None) -> Iterator[Cluster | None]:
    """Connect to a cluster as :func:`connect` does, if one is wanted.

    Raises:
        StudyError: see :func:`connect`.
    """
    if options is None:
        yield None
        return
    with connect(options) as cluster:
        yield cluster


def _init(ray: Any, address: str) -> None:
    """Connect this process to a cluster.

    Ray puts the folder in which a driver connects first on the path of its workers, on every node, so that a ``json.py``
    beside a study would run there. So this process is in Python's own folder meanwhile.

    Raises:
        StudyError: nobody answers at the address.
    """
    if ":" in address and not _answers(address):
        raise StudyError(f"--ray {address}: cannot reach a Ray cluster at this address")
    try:
        with chdir(sys.prefix):
            ray.init(address, log_to_driver=False, logging_level="error")
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        if "No node info found" in str(error):
            raise StudyError(
                f"--ray {address}: this machine is not a node of that cluster; run the command on a node, or give ray://HOST:10001"
            ) from None
        hint = "; if the cluster asks for a token, set RAY_AUTH_MODE=token and RAY_AUTH_TOKEN"
        raise StudyError(
            f"--ray {address}: cannot reach a Ray cluster at this address: {first_line(error)}{hint}"
        ) from None


def _head(ray: Any) -> str:
    """Return the address of the head's store; empty for a Ray client, whose connection is its own."""
    try:
        return str(ray.get_runtime_context().gcs_address)
    except (AttributeError, RuntimeError, ray.exceptions.RayError):
        return ""


def _answers(address: str) -> bool:
    """Return whether something listens at an address; Ray itself would try for minutes."""
    host, port = _host_and_port(address.removeprefix("ray://"))
    hosts = [host]
    if host in ("localhost", "127.0.0.1", "::1"):  # for Ray, that is any address of this machine
        families = (socket.AF_INET, socket.AF_INET6)
        hosts += [one.address for some in psutil.net_if_addrs().values() for one in some if one.family in families]
    return any(_listens(candidate, port) for candidate in hosts)


def _host_and_port(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    return host.strip("[]"), int(port)


def _listens(host: str, port: int) -> bool:
    """Return whether something listens at a port."""
    try:
        socket.create_connection((host, port), timeout=_ANSWER_S).close()
    except (OSError, OverflowError):
        return False
    return True


def first_line(error: BaseException) -> str:
    """Return the first line of an error of Ray, whose messages are long."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _running_ray() -> Any:
    """Return Ray if it runs in this process already, else ``None``."""
    ray = sys.modules.get("ray")
    return ray if ray is not None and ray.is_initialized() else None


def prepare_environment(address: str) -> None:
    """Set what Ray reads when it is imported: a token and the loopback interface for a cluster that is started here.

    Raises:
        StudyError: ``RAY_AUTH_MODE`` is ``token`` and there is no token, for which Ray would wait in silence; or Ray has been
            imported already, so that a cluster that it starts would be open to the network.
    """
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    if path := os.environ.get(_TOKEN_FILE):
        os.environ[_TOKEN_FILE] = os.path.abspath(path)  # Ray reads it in another folder, see `_init`
    if address == LOCAL:
        wanted = {_ON_NETWORK: "0", "RAY_AUTH_MODE": os.environ.get("RAY_AUTH_MODE", "token")}
        if wanted["RAY_AUTH_MODE"] == "token" and not _has_token():
            wanted["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
        if sys.modules.get("ray") is not None and any(os.environ.get(name) != value for name, value in wanted.items()):
            raise StudyError("--ray local: Ray was imported before; start it with ray.init() first, or give an address")
        os.environ |= wanted
    if os.environ.get("RAY_AUTH_MODE") == "token" and not _has_token():
        raise StudyError(
            "RAY_AUTH_MODE is token and there is no token: set RAY_AUTH_TOKEN, or RAY_AUTH_TOKEN_PATH to a file with it, "
            "or write it to ~/.ray/auth_token"
        )


def _has_token() -> bool:
    if os.environ.get("RAY_AUTH_TOKEN"):
        return True
    path = os.environ.get(_TOKEN_FILE)
    return (Path(path) if path else Path.home() / ".ray" / "auth_token").is_file()

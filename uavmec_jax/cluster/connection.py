"""Start Ray on this machine, or join a cluster."""

import os
import re
import secrets
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uavmec_jax.cluster.options import LOCAL, RayOptions
from uavmec_jax.errors import StudyError
from uavmec_jax.files.extras import optional

_ADDRESS = re.compile(r"auto|local|(ray://)?[^/\s:]+:\d+|(ray://)?\[[0-9a-fA-F:]+\]:\d+")

_QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # else Ray warns of a change to come
}


@dataclass(frozen=True)
class Cluster:
    """A cluster that this process is connected to.

    Attributes:
        ray: the module ``ray``.
        options: what each shard needs.
    """

    ray: Any
    options: RayOptions

    @property
    def requirements(self) -> dict[str, Any]:
        """What a shard needs, as Ray's task options."""
        gpus, resources = self.options.gpus_per_shard, dict(self.options.resources)
        return {"num_cpus": cpus_per_shard(self.options), "num_gpus": gpus, "resources": resources or None}

    def nodes(self) -> list[dict[str, Any]]:
        """Return the nodes that are alive, as Ray describes them."""
        return [node for node in self.ray.nodes() if node["Alive"]]

    def slots(self) -> int:
        """Return how many shards the present nodes can take at the same time."""
        needed = {"CPU": cpus_per_shard(self.options), "GPU": self.options.gpus_per_shard} | dict(
            self.options.resources
        )
        return sum(
            int(min(node["Resources"].get(name, 0.0) // amount for name, amount in needed.items() if amount))
            for node in self.nodes()
        )


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
            f"--ray {address}: is no address of a Ray cluster; give host:port, ray://host:port, auto or local"
        )
    _check_token(address)
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    ray = optional("ray", "--ray", "ray")
    if ray.is_initialized():
        yield Cluster(ray, options)
        return
    _init(ray, address)
    try:
        cluster = Cluster(ray, options)
        if address == LOCAL and not cluster.slots():
            needed = ", ".join(f"{name} {amount}" for name, amount in cluster.requirements.items() if amount)
            raise StudyError(f"--ray local: this machine cannot take a shard, which needs {needed}; ask for less")
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
    """Initialise Ray in this process.

    Raises:
        StudyError: nobody answers at the address.
    """
    quiet = {"log_to_driver": False, "logging_level": "error"}
    try:
        with warnings.catch_warnings():
            # JAX warns of every fork once its threads run; Ray's processes are other programs from the first moment on.
            warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
            _start_or_join(ray, address, quiet)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        raise StudyError(f"--ray {address}: no cluster answers there: {first_line(error)}") from None


def _start_or_join(ray: Any, address: str, quiet: dict[str, Any]) -> None:
    if address != LOCAL:
        ray.init(address, **quiet)
        return
    # Loopback only: on the machine's outer address Ray would be open to the network.
    here = {"num_cpus": n_cores(), "include_dashboard": False, "_node_ip_address": "127.0.0.1"}
    ray.init(LOCAL, **here, **quiet)


def first_line(error: BaseException) -> str:
    """Return the first line of an error of Ray, whose messages are long."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _check_token(address: str) -> None:
    """See to it that a local cluster is started with a token, and that a token is there where one is asked for.

    Ray reads both variables when it is imported, and without a token waits for a minute before it gives up.

    Raises:
        StudyError: ``RAY_AUTH_MODE`` is ``token`` and there is no token.
    """
    if address == LOCAL and "RAY_AUTH_MODE" not in os.environ:
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
    if os.environ.get("RAY_AUTH_MODE") == "token" and not _has_token():
        raise StudyError(
            "RAY_AUTH_MODE is token and there is no token: set RAY_AUTH_TOKEN, or RAY_AUTH_TOKEN_PATH to a file with it, "
            "or write it to ~/.ray/auth_token"
        )


def _has_token() -> bool:
    if os.environ.get("RAY_AUTH_TOKEN"):
        return True
    path = os.environ.get("RAY_AUTH_TOKEN_PATH")
    return (Path(path) if path else Path.home() / ".ray" / "auth_token").is_file()

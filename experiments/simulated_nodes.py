"""A Ray cluster whose nodes are processes of this machine, for the scripts beside this one."""

import os
from typing import Any

import psutil

from uavmec_jax.cluster.connection import prepare_environment
from uavmec_jax.cluster.options import LOCAL


class SimulatedNodes:
    """A head that takes no shards, and nodes with so many cores each; they all listen on the loopback interface alone.

    Attributes:
        cluster: Ray's own object for such clusters.
        cpus: cores of a node, as it tells the head.
        pinned: whether each node keeps to one core of this machine, in turn.
    """

    def __init__(self, nodes: int, cpus: int, *, pinned: bool = False) -> None:
        prepare_environment(LOCAL)
        from ray.cluster_utils import Cluster

        head = {"num_cpus": 0, "node_ip_address": "127.0.0.1", "include_dashboard": False}
        self.cluster: Any = Cluster(initialize_head=True, head_node_args=head)
        self.cpus, self.pinned = cpus, pinned
        for _ in range(nodes):
            self.add()

    @property
    def address(self) -> str:
        """Address of the head."""
        return str(self.cluster.address)

    @property
    def workers(self) -> list[Any]:
        """The nodes that take shards, in a fixed order."""
        return sorted(self.cluster.worker_nodes, key=str)

    def add(self) -> None:
        """Add a node."""
        before, count = _raylets(), len(self.workers)
        self.cluster.add_node(num_cpus=self.cpus, node_ip_address="127.0.0.1")
        cores = sorted(os.sched_getaffinity(0))
        for process in _raylets() - before if self.pinned else ():
            process.cpu_affinity([cores[count % len(cores)]])

    def kill(self, node: Any) -> None:
        """Kill a node and everything on it."""
        self.cluster.remove_node(node, allow_graceful=False)

    def kill_head(self) -> None:
        """Kill the store of the head, without which a cluster can do nothing."""
        for process in psutil.Process().children(recursive=True):
            if process.name() == "gcs_server":
                process.kill()

    def shutdown(self) -> None:
        """End all nodes and the head."""
        self.cluster.shutdown()


def _raylets() -> set[psutil.Process]:
    """Return the daemons of the nodes of this process."""
    return {one for one in psutil.Process().children(recursive=True) if one.name() == "raylet"}

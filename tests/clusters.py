"""A Ray cluster of several nodes, each a set of processes on this machine, which nothing outside it can reach."""

from collections.abc import Iterator
from contextlib import contextmanager

from uavmec_jax.cluster.connection import prepare_environment
from uavmec_jax.cluster.options import LOCAL

FORK = "ignore:os.fork"
"""Filter for JAX's warning: Ray starts simulated nodes by forking, here, where JAX has been imported."""

CPUS = 2
"""Cores that each node claims to have, whatever the machine has: as many as the tests' devices."""


@contextmanager
def simulated_cluster(nodes: int, **resources) -> Iterator:
    """Start a cluster of so many nodes and a head that takes no work; yield Ray's own object for such clusters."""
    prepare_environment(LOCAL)
    import ray
    from ray.cluster_utils import Cluster

    head = {"num_cpus": 0, "node_ip_address": "127.0.0.1", "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    try:
        for _ in range(nodes):
            add_node(cluster, **resources)
        yield cluster
    finally:
        if ray.is_initialized():
            ray.shutdown()
        cluster.shutdown()


def add_node(cluster, **resources):
    """Add a node."""
    return cluster.add_node(num_cpus=CPUS, node_ip_address="127.0.0.1", **resources)

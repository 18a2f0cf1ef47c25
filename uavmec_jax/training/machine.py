"""What a shard has for its training, on this machine or on a node of a cluster."""

from dataclasses import dataclass, replace
from typing import Any

import jax

from uavmec_jax.cluster.connection import Cluster, cpus_per_shard, n_cores
from uavmec_jax.cluster.tasks import Task, TaskError, TaskRun
from uavmec_jax.cluster.worker import node_name
from uavmec_jax.errors import StudyError
from uavmec_jax.training import host
from uavmec_jax.training.partition import Partition, partition_population


@dataclass(frozen=True)
class Machine:
    """What a shard has for its training.

    Attributes:
        devices: JAX devices.
        accelerator: whether they are accelerators rather than cores.
        free_bytes: memory of all of them together, see :func:`host.free_memory`.
    """

    devices: int
    accelerator: bool
    free_bytes: int

    @classmethod
    def here(cls) -> "Machine":
        """Return this machine."""
        return cls(jax.local_device_count(), jax.default_backend() != "cpu", host.free_memory())

    def partition(self, n_agents: int, agent_bytes: int) -> Partition:
        """Partition a population for it, see :func:`partition_population`.

        Raises:
            PopulationTooLargeError: one agent does not fit.
        """
        return partition_population(
            n_agents, agent_bytes, self.free_bytes, groups=self.devices, accelerator=self.accelerator
        )


def probe_node(cluster: Cluster) -> Machine:
    """Return what a shard has on a node of the cluster, which may be waited for.

    Raises:
        StudyError: the package on the node is another version.
    """
    task = Task("probe", _describe_node, lambda: (cpus_per_shard(cluster.options), host.code_digest(), host.versions()))
    ((_, machine),) = TaskRun(cluster).results([task])
    if isinstance(machine, TaskError):
        raise StudyError(f"a node of the Ray cluster: {machine.error}")
    return Machine(**machine)


def _describe_node(devices: int, code: str, versions: dict[str, str]) -> dict[str, Any]:
    """Return the fields of :class:`Machine`; this runs on a node."""
    host.use_all_cores(devices)
    here = {"uavmec_jax's code": host.code_digest()} | host.versions()
    there = {"uavmec_jax's code": code} | versions
    if differ := [f"{name} {there[name][:12]} -> {here[name][:12]}" for name in here if here[name] != there[name]]:
        raise StudyError(f"{node_name()} has other code than the driver ({', '.join(differ)}); install the same there")
    machine = Machine.here()
    share = 1.0 if machine.accelerator else min(devices / n_cores(), 1.0)  # other shards may be on the node too
    return vars(replace(machine, free_bytes=int(share * machine.free_bytes)))

"""What a shard has for its training, on this machine or on a node of a cluster."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import jax

from uavmec_jax.cluster.connection import Cluster, cpus_per_shard, n_cores
from uavmec_jax.cluster.tasks import Task, TaskError, TaskRun
from uavmec_jax.cluster.worker import node_name, time_limit
from uavmec_jax.errors import StudyError, UserError
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


@dataclass(frozen=True)
class WorkerOptions:
    """What the process of a task is told.

    Attributes:
        cpus, gpus: what the task may use.
        code: the driver's, see :func:`host.code`.
        time_limit_s: seconds after which the process is ended.
    """

    cpus: int
    gpus: int
    code: dict[str, str]
    time_limit_s: float | None

    @classmethod
    def of(cls, cluster: Cluster) -> "WorkerOptions":
        """Return what the tasks on a cluster are told."""
        options = cluster.options
        return cls(cpus_per_shard(options), options.gpus_per_shard, host.code(), options.time_limit_s)

    @contextmanager
    def prepared(self) -> Iterator[None]:
        """Prepare this process, which is on a node, and name the node in errors.

        Raises:
            StudyError: the node has other code than the driver, or not the GPUs; or what is raised inside.
        """
        with time_limit(self.time_limit_s):
            try:
                if differ := host.code_differences(self.code):
                    raise StudyError(f"has other code than the driver ({', '.join(differ)}); install the same there")
                host.use_devices(self.cpus, self.gpus)
                yield
            except UserError as error:
                raise StudyError(f"node {node_name()}: {error}") from error


def probe_node(
    cluster: Cluster, on_event: Callable[[str, dict[str, Any]], None] = lambda event, facts: None
) -> Machine:
    """Return what a shard has on a node of the cluster, which may be waited for.

    Args:
        cluster: the cluster.
        on_event: called with ``(event, facts)`` if no node can take a shard, or an attempt is lost or retried; the facts are
            ``error`` and perhaps ``shard``, which is then ``probe``.

    Raises:
        StudyError: the node has other code than the driver, or not the GPUs.
    """

    def report(event: str, *, error: str, task: str | None = None) -> None:
        on_event(event, {"error": error} if task is None else {"error": error, "shard": task})

    probe = Task("probe", _describe_node, lambda: (WorkerOptions.of(cluster),))
    ((_, machine),) = TaskRun(cluster, on_event=report).results([probe])
    if isinstance(machine, TaskError):
        raise StudyError(machine.error.removeprefix("StudyError: "))
    return Machine(**machine)


def _describe_node(worker: WorkerOptions) -> dict[str, Any]:
    """Return the fields of :class:`Machine`; this runs on a node."""
    with worker.prepared():
        free = host.free_memory()
    share = 1.0 if worker.gpus else min(worker.cpus / n_cores(), 1.0)  # other shards may be on the node too
    return {"devices": worker.gpus or worker.cpus, "accelerator": worker.gpus > 0, "free_bytes": int(share * free)}

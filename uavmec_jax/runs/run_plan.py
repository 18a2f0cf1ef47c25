"""The run plan: how a study is cut into shards and what it costs, known before anything is compiled or written."""

from dataclasses import dataclass
from functools import cached_property

import jax

from uavmec_jax.errors import StudyError
from uavmec_jax.studies.places import load_evacuations
from uavmec_jax.studies.population import make_algorithm, n_agents, split_by_algorithm
from uavmec_jax.studies.schema import Study
from uavmec_jax.training import host
from uavmec_jax.training.partition import Partition, PopulationTooLargeError, partition_population

_UNTRAINED_SHARD = 100
"""Scenarios in a shard where nothing is trained."""

BYTES_WITHOUT_TRAINING = 100_000
"""A finished agent, in memory and on disk: two sets of weights, evaluation, curves."""


@dataclass(frozen=True)
class Shard:
    """Agents of one algorithm that one process trains and evaluates as one piece.

    Attributes:
        number: in the plan, from 0.
        algorithm: its name, ``none`` where nothing is trained.
        first: its first agent, among those of the algorithm.
        agents: number of agents; a shard is padded to the size of all others.
    """

    number: int
    algorithm: str
    first: int
    agents: int


@dataclass(frozen=True)
class RunPlan:
    """How a study is cut. It is part of the result: the last bits depend on the size of a group of agents.

    Attributes:
        agents: of all algorithms.
        partitions: algorithm -> how its agents are cut.
        members: algorithm -> number of its agents.
        steps: algorithm -> environment steps of one agent, in whole iterations; 0 where nothing is trained.
        workers: processes that it was made for.
        free_bytes: memory that was free.
    """

    agents: int
    partitions: dict[str, Partition]
    members: dict[str, int]
    steps: dict[str, int]
    workers: int
    free_bytes: int

    @cached_property
    def shards(self) -> list[Shard]:
        """The shards in the order of the results: algorithm after algorithm."""
        shards: list[Shard] = []
        for name, cut in self.partitions.items():
            for first in range(0, cut.shards * cut.shard_size, cut.shard_size):
                agents = min(cut.shard_size, self.members[name] - first)
                shards.append(Shard(len(shards), name, first, agents))
        return shards

    @property
    def total_steps(self) -> int:
        """Environment steps of all agents."""
        return sum(self.members[name] * self.steps[name] for name in self.partitions)

    @property
    def work(self) -> int:
        """The unit of progress: environment steps, or scenarios where nothing is trained."""
        return self.total_steps or self.agents

    def work_of(self, shard: Shard) -> int:
        """Return a shard's part of :attr:`work`."""
        return shard.agents * (self.steps[shard.algorithm] or 1)

    def __str__(self) -> str:
        if not self.total_steps:
            return f"{self.agents} scenarios, nothing is trained"
        cuts, count = list(self.partitions.values()), len(self.shards)
        sizes = "+".join(f"{cut.shards} x {cut.shard_size}" for cut in cuts)
        of_size = f" ({sizes})" if len(cuts) > 1 else f" of {cuts[0].shard_size}"
        needed = self.workers * max(cut.shard_bytes for cut in cuts)
        memory = f"{needed / 2**30:.2f} GiB of {self.free_bytes / 2**30:.1f} GiB free"
        groups = max(cut.groups for cut in cuts)
        devices = f"{groups} device{'s' * (groups > 1)}"
        devices = f"{self.workers} workers with {devices} each" if self.workers > 1 else devices
        steps = self.total_steps // self.agents
        return f"{self.agents:,} agents x {steps:,} steps in {count} shard{'s' * (count > 1)}{of_size} on {devices}, {memory}"


def plan_run(study: Study, *, workers: int = 1, shard_size: int | None = None, jobs: int = 1) -> RunPlan:
    """Estimate memory and cut the population into equal shards.

    Args:
        study: what is run.
        workers: processes on this host that share its devices and its memory.
        shard_size: most agents in a shard; by default what the devices' caches hold.
        jobs: workers on all hosts together; there is a shard for each, if there are as many agents.

    Raises:
        StudyError: the population does not fit in memory.
        TrafficError: a place of the study is not usable.
    """
    load_evacuations(study)
    agents, free = n_agents(study), host.free_memory()
    needed = agents * BYTES_WITHOUT_TRAINING
    if needed > free:
        raise StudyError(
            f"{study.name}: {agents:,} agents need {needed / 2**30:,.0f} GiB of memory, and as much disk, when all are "
            f"trained; {free / 2**30:.1f} GiB are free; shorten an axis, or make several studies of it"
        )
    partitions: dict[str, Partition] = {}
    members: dict[str, int] = {}
    steps: dict[str, int] = {}
    for own in split_by_algorithm(study):
        algorithm, count = make_algorithm(own), n_agents(own)
        max_shard = min(shard_size or count, -(-count // max(workers, jobs)))
        members[own.algorithm], steps[own.algorithm] = count, algorithm.total_steps if algorithm else 0
        if algorithm is None:
            size = min(_UNTRAINED_SHARD, max_shard)
            partitions[own.algorithm] = Partition(shards=-(-count // size), shard_size=size, groups=1, shard_bytes=0)
            continue
        try:
            partitions[own.algorithm] = partition_population(
                count,
                algorithm.agent_bytes,
                (free - needed) // workers,
                groups=max(jax.local_device_count() // workers, 1),
                max_shard=max_shard if max_shard < count else None,
            )
        except PopulationTooLargeError as error:
            raise StudyError(f"{study.name}: steps is {study.steps}: {error}") from None
    return RunPlan(agents=agents, partitions=partitions, members=members, steps=steps, workers=workers, free_bytes=free)

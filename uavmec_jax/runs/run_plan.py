"""The run plan: how a study is cut into shards, and the memory it needs, before anything is compiled or written."""

import datetime
import sys
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from uavmec_jax.env.checks import check_range
from uavmec_jax.errors import StudyError
from uavmec_jax.studies.parts import split_study
from uavmec_jax.studies.places import describe_places, load_evacuations
from uavmec_jax.studies.population import make_algorithm, n_agents, seeds_of
from uavmec_jax.studies.results import SCHEMA
from uavmec_jax.studies.schema import Study
from uavmec_jax.training import host
from uavmec_jax.training.machine import Machine
from uavmec_jax.training.partition import Partition, PopulationTooLargeError, partition_population

_UNTRAINED_SHARD = 100
"""Scenarios in a shard where nothing is trained."""

BYTES_WITHOUT_TRAINING = 100_000
"""Bytes of a finished agent, in memory and on disk: two sets of weights, evaluation, curves."""


@dataclass(frozen=True)
class Shard:
    """Agents of one part of the study that one process trains and evaluates together.

    Attributes:
        number: its place in the plan, from 0.
        part: name of the part, see :class:`Part`: that of the algorithm, ``none`` where nothing is trained, and the fleet.
        first: its first agent, counted among those of the part.
        agents: number of agents, without the padding to the common size of the part's shards.
    """

    number: int
    part: str
    first: int
    agents: int


@dataclass(frozen=True)
class RunPlan:
    """How a study is cut into shards. It is part of the result: the last bits depend on the size of a group.

    Attributes:
        agents: number of agents of all parts.
        partitions: part -> how its agents are partitioned.
        members: part -> number of its agents.
        steps: part -> environment steps of one agent, in whole iterations; 0 where nothing is trained.
        free_bytes: free memory when the plan was made.
    """

    agents: int
    partitions: dict[str, Partition]
    members: dict[str, int]
    steps: dict[str, int]
    free_bytes: int

    @cached_property
    def shards(self) -> list[Shard]:
        """The shards in the order of the results, one part after the other."""
        shards: list[Shard] = []
        for name, partition in self.partitions.items():
            for first in range(0, partition.shards * partition.shard_size, partition.shard_size):
                agents = min(partition.shard_size, self.members[name] - first)
                shards.append(Shard(len(shards), name, first, agents))
        return shards

    @property
    def total_steps(self) -> int:
        """Environment steps of all agents."""
        return sum(self.members[name] * self.steps[name] for name in self.partitions)

    @property
    def work(self) -> int:
        """The whole work that progress counts: environment steps, or scenarios where nothing is trained."""
        return self.total_steps or self.agents

    def work_of(self, shard: Shard) -> int:
        """Return a shard's share of :attr:`work`."""
        return shard.agents * (self.steps[shard.part] or 1)

    def __str__(self) -> str:
        if not self.total_steps:
            return f"{self.agents} scenarios, nothing is trained"
        partitions, count = list(self.partitions.values()), len(self.shards)
        sizes = "+".join(f"{partition.shards} x {partition.shard_size}" for partition in partitions)
        of_size = f" ({sizes})" if len(partitions) > 1 else f" of {partitions[0].shard_size}"
        needed = max(partition.shard_bytes for partition in partitions)
        memory = f"{needed / 2**30:.2f} GiB of {self.free_bytes / 2**30:.1f} GiB free"
        groups = max(partition.groups for partition in partitions)
        devices = f"{groups} device{'s' * (groups > 1)}"
        steps = self.total_steps // self.agents
        return f"{self.agents:,} agents x {steps:,} steps in {count} shard{'s' * (count > 1)}{of_size} on {devices}, {memory}"


def check_shard_size(shard_size: int | None) -> None:
    """Check the number of agents in a shard, if one is given.

    Raises:
        ArgumentError: it is not a positive number; one line.
    """
    if shard_size is not None:
        check_range("shard_size", shard_size, ge=1, whole=True)


def plan_run(study: Study, *, shard_size: int | None = None, machine: Machine | None = None) -> RunPlan:
    """Estimate the memory of a study and cut its population into equal shards.

    Args:
        study: the study to run.
        shard_size: most agents in a shard; by default as many as the devices' caches hold.
        machine: what a shard has; by default this machine.

    Raises:
        ArgumentError: ``shard_size`` is not a positive number.
        StudyError: the population does not fit in memory.
        TrafficError: the traffic of one of the study's places is not usable.
    """
    check_shard_size(shard_size)
    load_evacuations(study)
    machine = machine or Machine.here()
    agents, free = n_agents(study), host.free_memory()
    needed = agents * BYTES_WITHOUT_TRAINING
    if needed > free:
        raise StudyError(
            f"{study.name}: {agents:,} agents need {needed / 2**30:,.0f} GiB of memory, and as much disk, when all are "
            f"trained; {free / 2**30:.1f} GiB are free; shorten an axis, or split it into several studies"
        )
    partitions: dict[str, Partition] = {}
    members: dict[str, int] = {}
    steps: dict[str, int] = {}
    for part in split_study(study):
        name, algorithm, count = part.name, make_algorithm(part.study), n_agents(part.study)
        members[name], steps[name] = count, algorithm.total_steps if algorithm else 0
        if algorithm is None:
            size = min(_UNTRAINED_SHARD, shard_size or count, count)
            partitions[name] = Partition(shards=-(-count // size), shard_size=size, groups=1, shard_bytes=0)
            continue
        try:
            partitions[name] = partition_population(
                count,
                algorithm.agent_bytes,
                machine.free_bytes - needed,
                groups=machine.devices,
                max_shard=shard_size if shard_size and shard_size < count else None,
                accelerator=machine.accelerator,
            )
        except PopulationTooLargeError as error:
            raise StudyError(f"{study.name}: steps is {study.steps}: {error}") from None
    return RunPlan(agents=agents, partitions=partitions, members=members, steps=steps, free_bytes=machine.free_bytes)


def label_of(study: Study, plan: RunPlan, command: str | None) -> dict[str, Any]:
    """Return the label of a run, what ``run.json`` says before it starts: study, command, partitions, versions, hardware."""
    return {
        "schema": SCHEMA,
        "study": study.name,
        "command": command or " ".join(sys.argv),
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "complete": False,
        "agents": plan.agents,
        "seeds": seeds_of(study),
        **({"places": places} if (places := describe_places(study)) else {}),
        "partitions": {name: asdict(partition) for name, partition in plan.partitions.items()},
        **host.describe(),
    }

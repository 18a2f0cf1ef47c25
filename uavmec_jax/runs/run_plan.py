"""What a run will take, known before anything is compiled or written: how a study is cut into shards, and what it costs."""

from dataclasses import dataclass
from functools import cached_property

import jax

from uavmec_jax.errors import StudyError
from uavmec_jax.studies.places import load_evacuations
from uavmec_jax.studies.population import make_algorithm, n_agents, parts
from uavmec_jax.studies.schema import Study
from uavmec_jax.training import host
from uavmec_jax.training.partition import Blocks, PopulationTooLargeError, plan_blocks

_UNTRAINED_BLOCK = 100
"""Scenarios in a shard where nothing is trained."""

BYTES_WITHOUT_TRAINING = 100_000
"""An agent that is done, in memory and on disk: two sets of weights, evaluation, curves."""


@dataclass(frozen=True)
class Shard:
    """Agents that one process trains and judges as one piece: a block of one algorithm.

    Attributes:
        number: in the plan, from 0.
        algorithm: its name, ``none`` where nothing is trained.
        first: its first agent, among those of the algorithm.
        agents: how many; the block is padded to the size of all others.
    """

    number: int
    algorithm: str
    first: int
    agents: int


@dataclass(frozen=True)
class Plan:
    """How a study is cut. It is part of the result: the size of a group of agents decides over the last bits.

    Attributes:
        agents: in all.
        blocks: algorithm -> how its agents are cut.
        members: algorithm -> its agents.
        steps: algorithm -> environment steps of one agent, in whole iterations; 0 where nothing is trained.
        workers: processes that it was made for.
        free_bytes: memory that was free.
    """

    agents: int
    blocks: dict[str, Blocks]
    members: dict[str, int]
    steps: dict[str, int]
    workers: int
    free_bytes: int

    @cached_property
    def shards(self) -> list[Shard]:
        """In the order of the results: algorithm after algorithm."""
        found: list[Shard] = []
        for name, cut in self.blocks.items():
            for first in range(0, cut.count * cut.size, cut.size):
                found.append(Shard(len(found), name, first, min(cut.size, self.members[name] - first)))
        return found

    @property
    def total_steps(self) -> int:
        """Environment steps of all agents."""
        return sum(self.members[name] * self.steps[name] for name in self.blocks)

    @property
    def work(self) -> int:
        """What progress is counted in: environment steps, or scenarios where nothing is trained."""
        return self.total_steps or self.agents

    def work_of(self, shard: Shard) -> int:
        """A shard's part of :attr:`work`."""
        return shard.agents * (self.steps[shard.algorithm] or 1)

    def __str__(self) -> str:
        if not self.total_steps:
            return f"{self.agents} scenarios, nothing is trained"
        every = list(self.blocks.values())
        count = len(self.shards)
        sizes = "+".join(f"{blocks.count} x {blocks.size}" for blocks in every)
        cut = f"{count} shard{'s' * (count > 1)}{f' ({sizes})' if len(every) > 1 else f' of {every[0].size}'}"
        memory = (
            f"{self.workers * max(b.bytes for b in every) / 2**30:.2f} GiB of {self.free_bytes / 2**30:.1f} GiB free"
        )
        groups = max(blocks.groups for blocks in every)
        by = f"{groups} device{'s' * (groups > 1)}"
        by = f"{self.workers} workers with {by} each" if self.workers > 1 else by
        return f"{self.agents:,} agents x {self.total_steps // self.agents:,} steps in {cut} on {by}, {memory}"


def plan_study(study: Study, *, workers: int = 1, shard_size: int | None = None, jobs: int = 1) -> Plan:
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
    groups = max(jax.local_device_count() // workers, 1)
    blocks: dict[str, Blocks] = {}
    members: dict[str, int] = {}
    steps: dict[str, int] = {}
    for part in parts(study):
        algorithm, own = make_algorithm(part), n_agents(part)
        largest = min(shard_size or own, -(-own // max(workers, jobs)))
        members[part.algorithm] = own
        steps[part.algorithm] = algorithm.total_steps if algorithm else 0
        if algorithm is None:
            size = min(_UNTRAINED_BLOCK, largest)
            blocks[part.algorithm] = Blocks(count=-(-own // size), size=size, groups=1, bytes=0)
            continue
        try:
            blocks[part.algorithm] = plan_blocks(
                own,
                algorithm.agent_bytes,
                (free - needed) // workers,
                groups=groups,
                largest=largest if largest < own else None,
            )
        except PopulationTooLargeError as error:
            raise StudyError(f"{study.name}: steps is {study.steps}: {error}") from None
    return Plan(agents=agents, blocks=blocks, members=members, steps=steps, workers=workers, free_bytes=free)

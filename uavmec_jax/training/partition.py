"""How a population is cut into shards, and a shard into the groups of agents that one program trains.

A shard is small enough for the machine: for its memory (the replay is what costs) and, on a CPU, for its caches. Its groups
are spread over the local devices. The last bits of a training depend on the size of a group, so it is part of a run's plan;
they do not depend on the number of devices that train the groups.
"""

from dataclasses import dataclass

import jax

AGENTS_PER_CORE = 40
"""Largest group on a CPU core: beyond it, weights and Adam's moments leave the core's cache."""

AGENTS_PER_ACCELERATOR = 8192
"""Largest group on an accelerator; memory is usually the tighter limit."""


class PopulationTooLargeError(ValueError):
    """Not even the smallest shard of the population fits in memory."""


@dataclass(frozen=True)
class Partition:
    """A population cut into equal shards.

    Attributes:
        shards: number of shards.
        shard_size: agents in each of them; the last one is padded.
        groups: groups of equal size in a shard.
        shard_bytes: memory of a shard in training.
    """

    shards: int
    shard_size: int
    groups: int
    shard_bytes: int

    @property
    def group_size(self) -> int:
        """Agents in a group."""
        return self.shard_size // self.groups

    @property
    def devices(self) -> int:
        """Local devices that share the groups of a shard: as many as can have equally many groups each."""
        local = jax.local_device_count()
        return max(n for n in range(1, min(self.groups, local) + 1) if self.groups % n == 0)


def partition_population(
    n_agents: int, agent_bytes: int, memory_limit: int, *, groups: int | None = None, max_shard: int | None = None
) -> Partition:
    """Cut ``n_agents`` into equal shards that fit into ``memory_limit`` bytes.

    Args:
        n_agents: size of the population.
        agent_bytes: memory of one agent in training.
        memory_limit: for one shard.
        groups: of a shard; by default one per local device.
        max_shard: most agents in a shard, if that is less than what the devices' caches hold.

    Raises:
        PopulationTooLargeError: one agent does not fit.
    """
    groups = min(groups or jax.local_device_count(), n_agents, max_shard or n_agents)
    per_group = AGENTS_PER_CORE if jax.default_backend() == "cpu" else AGENTS_PER_ACCELERATOR
    most = min(memory_limit // agent_bytes, per_group * groups, max_shard or per_group * groups) // groups * groups
    if most == 0 and memory_limit >= agent_bytes:
        groups = most = 1
    if most == 0:
        raise PopulationTooLargeError(
            f"one agent needs {agent_bytes / 2**30:.1f} GiB and {memory_limit / 2**30:.1f} GiB are free; "
            "lower the steps or the replay capacity"
        )
    shards = -(-n_agents // most)
    size = -(-n_agents // (shards * groups)) * groups
    return Partition(shards=shards, shard_size=size, groups=groups, shard_bytes=size * agent_bytes)

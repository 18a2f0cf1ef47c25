"""The partition of a population into shards, and of a shard into the groups of agents that one program trains.

A shard is small enough for the machine: for its memory (the replay buffers are the largest part) and, on a CPU, for its
caches. Its groups are distributed over the local devices. The bits of a training depend on the size of a group, which is
therefore part of a run's plan; they do not depend on the number of devices.
"""

from dataclasses import dataclass

import jax

AGENTS_PER_CORE = 40
"""Most agents in a group on a CPU core; with more, weights and Adam's moments no longer fit in the core's cache."""

AGENTS_PER_ACCELERATOR = 8192
"""Most agents in a group on an accelerator; memory is usually the tighter limit."""


class PopulationTooLargeError(ValueError):
    """Not even a shard of one agent fits in memory."""


@dataclass(frozen=True)
class Partition:
    """A partition of a population into shards of equal size.

    Attributes:
        shards: number of shards.
        shard_size: number of agents in each shard; the last one is padded.
        groups: number of groups in each shard, all of the same size.
        shard_bytes: memory of a shard in training.
    """

    shards: int
    shard_size: int
    groups: int
    shard_bytes: int

    @property
    def group_size(self) -> int:
        """Number of agents in a group."""
        return self.shard_size // self.groups

    @property
    def devices(self) -> int:
        """Number of local devices that train a shard: the most that can have equally many groups each."""
        most = min(self.groups, jax.local_device_count())
        return max(n for n in range(1, most + 1) if self.groups % n == 0)


def partition_population(
    n_agents: int,
    agent_bytes: int,
    memory_limit: int,
    *,
    groups: int | None = None,
    max_shard: int | None = None,
    accelerator: bool | None = None,
) -> Partition:
    """Partition ``n_agents`` agents into shards of equal size, each of which fits into ``memory_limit`` bytes.

    Args:
        n_agents: size of the population.
        agent_bytes: memory of one agent in training.
        memory_limit: memory of one shard, bytes.
        groups: number of groups in a shard; by default one per local device.
        max_shard: most agents in a shard; by default what the devices' caches hold.
        accelerator: whether the devices are accelerators; by default, whether those of this process are.

    Raises:
        PopulationTooLargeError: one agent does not fit.
    """
    groups = min(groups or jax.local_device_count(), n_agents, max_shard or n_agents)
    accelerator = jax.default_backend() != "cpu" if accelerator is None else accelerator
    per_group = AGENTS_PER_ACCELERATOR if accelerator else AGENTS_PER_CORE
    most = min(memory_limit // agent_bytes, per_group * groups, max_shard or per_group * groups) // groups * groups
    if most == 0 and memory_limit >= agent_bytes:
        groups = most = 1
    if most == 0:
        raise PopulationTooLargeError(
            f"one agent needs {agent_bytes / 2**30:.1f} GiB and {memory_limit / 2**30:.1f} GiB are free; "
            "lower the steps or the replay capacity"
        )
    shards = -(-n_agents // most)
    shard_size = -(-n_agents // (shards * groups)) * groups
    return Partition(shards=shards, shard_size=shard_size, groups=groups, shard_bytes=shard_size * agent_bytes)

"""How a population is cut into equal blocks, and a block into the groups of agents that one program trains.

A block is small enough for the machine: for its memory (the replay is what costs) and, on a CPU, for its caches. Its
groups are spread over the devices at hand. The size of a group is what the bits of a training hang on, so it belongs to
the plan of a run; on how many devices the groups are trained does not matter.
"""

from dataclasses import dataclass

import jax

AGENTS_PER_CORE = 40
"""Largest group on a CPU core: beyond it, weights and Adam's moments leave the core's cache."""

AGENTS_PER_ACCELERATOR = 8192
"""Largest group on an accelerator; memory is usually the tighter bound."""


class PopulationTooLargeError(ValueError):
    """Not even the smallest block of the population fits in memory."""


@dataclass(frozen=True)
class Blocks:
    """How a population is cut: ``count`` blocks of ``size`` agents in ``groups`` groups, ``bytes`` for each block."""

    count: int
    size: int
    groups: int
    bytes: int

    @property
    def devices(self) -> int:
        """Local devices that share the groups of a block: as many as can have equally many groups each."""
        at_hand = jax.local_device_count()
        return max(n for n in range(1, min(self.groups, at_hand) + 1) if self.groups % n == 0)


def plan_blocks(
    n_agents: int, agent_bytes: int, memory_limit: int, *, groups: int | None = None, largest: int | None = None
) -> Blocks:
    """Cut ``n_agents`` into equal blocks that fit into ``memory_limit`` bytes.

    Args:
        n_agents: size of the population.
        agent_bytes: memory of one agent in training.
        memory_limit: for one block.
        groups: of a block; by default one per local device.
        largest: agents in a block, if that is less than what the devices' caches hold.

    Raises:
        PopulationTooLargeError: one agent does not fit.
    """
    groups = min(groups or jax.local_device_count(), n_agents, largest or n_agents)
    per_group = AGENTS_PER_CORE if jax.default_backend() == "cpu" else AGENTS_PER_ACCELERATOR
    most = min(memory_limit // agent_bytes, per_group * groups, largest or per_group * groups) // groups * groups
    if most == 0 and memory_limit >= agent_bytes:
        groups = most = 1
    if most == 0:
        raise PopulationTooLargeError(
            f"one agent needs {agent_bytes / 2**30:.1f} GiB and {memory_limit / 2**30:.1f} GiB are free; "
            "lower the steps or the replay capacity"
        )
    count = -(-n_agents // most)
    size = -(-n_agents // (count * groups)) * groups
    return Blocks(count=count, size=size, groups=groups, bytes=size * agent_bytes)

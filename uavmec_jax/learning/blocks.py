"""How a population is cut into equal blocks that train one after the other.

A block is small enough for the machine: for its memory (the replay is what costs) and, on a CPU, for its caches.
"""

from dataclasses import dataclass

import jax

AGENTS_PER_CORE = 40
"""Largest block per CPU core: beyond it, weights and Adam's moments leave the core's cache."""

AGENTS_PER_ACCELERATOR = 8192
"""Largest block per accelerator; memory is usually the tighter bound."""


class PopulationTooLargeError(ValueError):
    """Not even the smallest block of the population fits in memory."""


@dataclass(frozen=True)
class Blocks:
    """How a population is cut: ``count`` blocks of ``size`` agents on ``devices`` devices, ``bytes`` for each block."""

    count: int
    size: int
    devices: int
    bytes: int


def plan_blocks(n_agents: int, agent_bytes: int, memory_limit: int) -> Blocks:
    """Cut ``n_agents`` into equal blocks that fit into ``memory_limit`` bytes.

    Raises:
        PopulationTooLargeError: one agent per device does not fit.
    """
    devices = min(jax.local_device_count(), n_agents)
    per_device = AGENTS_PER_CORE if jax.default_backend() == "cpu" else AGENTS_PER_ACCELERATOR
    largest = min(memory_limit // agent_bytes, per_device * devices) // devices * devices
    if largest == 0 and memory_limit >= agent_bytes:
        devices = largest = 1
    if largest == 0:
        raise PopulationTooLargeError(
            f"one agent needs {agent_bytes / 2**30:.1f} GiB and {memory_limit / 2**30:.1f} GiB are free; "
            "lower the steps or the replay capacity"
        )
    count = -(-n_agents // largest)
    size = -(-n_agents // (count * devices)) * devices
    return Blocks(count=count, size=size, devices=devices, bytes=size * agent_bytes)

"""Regroup a population: some of its agents continue in fewer shards of the same shape, without recompilation.

Regrouping works on what :meth:`Training.arrays` returns, so that it is the same wherever the shards were trained.
"""

from collections.abc import Iterator, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from uavmec_jax.training.partition import Partition
from uavmec_jax.training.training import Training


def shards_of(members: Int[np.ndarray, " members"], size: int) -> list[Int[np.ndarray, " B"]]:
    """Cut the indices of agents into shards of equal size; the last one is padded with its last agent."""
    n_shards = -(-len(members) // size)
    return list(members[np.minimum(np.arange(n_shards * size), len(members) - 1)].reshape(n_shards, size))


def regroup_arrays(
    saved: Sequence[Mapping[str, np.ndarray]], members: Int[np.ndarray, " members"], partition: Partition
) -> Iterator[dict[str, np.ndarray]]:
    """Yield the arrays of the shards in which some agents continue, one shard at a time: each may be large.

    Args:
        saved: for each shard of one population, in its order and after the same number of chunks, its arrays, see
            :meth:`Training.arrays`.
        members: indices in the population of the agents to keep, in their new order.
        partition: how the population is partitioned.
    """
    size, group_size = partition.shard_size, partition.group_size
    curves = [name for name in saved[0] if name.startswith("curves/")]
    leaves = [name.removeprefix("0/") for name in saved[0] if name.startswith("0/")]
    for shard in shards_of(members, size):
        arrays = {
            name: np.stack([saved[agent // size][name][:, agent % size] for agent in shard], 1) for name in curves
        }
        for group in range(partition.groups):
            agents = shard[group * group_size : (group + 1) * group_size]
            places = [(agent // size, agent % size // group_size, agent % group_size) for agent in agents]
            for leaf in leaves:
                arrays[f"{group}/{leaf}"] = np.stack(
                    [saved[old][f"{number}/{leaf}"][row] for old, number, row in places]
                )
        yield arrays


def regroup(trainings: list[Training], members: Int[np.ndarray, " members"]) -> list[Training]:
    """Move some agents into fewer shards of the same shape. The given trainings must not be used afterwards.

    Args:
        trainings: the shards of one population, in its order, after the same number of chunks.
        members: indices in the population of the agents to keep, in their new order.
    """
    trainer = trainings[0].trainer
    batches = [(batch.agents, batch.keys) for training in trainings for batch in training.group_batches]
    device = jax.local_devices()[0]
    population = jax.tree.map(lambda *leaves: jnp.concatenate(jax.device_put(list(leaves), device)), *batches)
    saved = [training.arrays() for training in trainings]
    regrouped = []
    shards = shards_of(members, trainer.partition.shard_size)
    for shard, arrays in zip(shards, regroup_arrays(saved, members, trainer.partition), strict=True):
        training = trainer.start(*jax.tree.map(lambda leaf, shard=shard: leaf[shard], population))
        training.restore(trainings[0].chunks_done, arrays)
        regrouped.append(training)
    return regrouped

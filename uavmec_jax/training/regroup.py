"""Continue the training of some agents of a population in fewer shards of the same shape, without recompilation."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from uavmec_jax.training.programs import put_on_mesh
from uavmec_jax.training.training import GroupBatch, Training


def regroup(trainings: list[Training], members: np.ndarray) -> list[Training]:
    """Move some agents into fewer shards of the same shape. The given trainings must not be used afterwards.

    Args:
        trainings: the shards of one population, in its order, after the same number of chunks.
        members: indices in the population of the agents to keep, in their new order.
    """
    trainer = trainings[0].trainer
    size, batch_size = trainer.partition.shard_size, trainer.partition.group_size * trainer.mesh.size
    n_shards = -(-len(members) // size)
    padded = members[np.minimum(np.arange(n_shards * size), len(members) - 1)].reshape(n_shards, size)

    def select(*leaves: Array) -> list[Array]:
        whole = jnp.concatenate([jax.device_put(leaf, jax.local_devices()[0]) for leaf in leaves])
        return [whole[shard[k : k + batch_size]] for shard in padded for k in range(0, size, batch_size)]

    trees = [
        (batch.agents, batch.keys, batch.state, batch.best)
        for training in trainings
        for batch in training.group_batches
    ]
    selected = [select(*leaves) for leaves in zip(*map(jax.tree.leaves, trees), strict=True)]
    structure = jax.tree.structure(trees[0])
    batches = [
        GroupBatch(*put_on_mesh(trainer.mesh, jax.tree.unflatten(structure, leaves)))
        for leaves in zip(*selected, strict=True)
    ]
    per_shard = len(batches) // n_shards
    regrouped = []
    for k, shard in enumerate(padded):
        training = Training(trainer, batches[k * per_shard : (k + 1) * per_shard], trainings[0].chunks_done)
        for name in ("episode_slots", "episodes", "scores"):
            if getattr(trainings[0], name):
                curves = np.concatenate([np.stack(getattr(old, name), 1) for old in trainings])
                setattr(training, name, list(curves[shard].T))
        regrouped.append(training)
    return regrouped

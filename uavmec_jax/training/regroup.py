"""Continue with some agents of a population in fewer shards of the same shape, without compiling anything anew."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from uavmec_jax.training.programs import put_on_mesh
from uavmec_jax.training.training import GroupBatch, Training


def regroup(trainings: list[Training], members: np.ndarray) -> list[Training]:
    """Move some agents of several shards that are equally far into fewer shards of the same shape.

    The old trainings must not be used any more.

    Args:
        trainings: shards of one population, in its order.
        members: places in the population, in the order that they are to have.
    """
    trainer = trainings[0].trainer
    size, per_batch = trainer.partition.shard_size, trainer.partition.group_size * trainer.mesh.size
    shards = -(-len(members) // size)
    places = members[np.minimum(np.arange(shards * size), len(members) - 1)].reshape(shards, size)

    def regrouped(*leaves: Any) -> list[Any]:
        all_agents = jnp.concatenate([jax.device_put(leaf, jax.local_devices()[0]) for leaf in leaves])
        return [all_agents[own[k : k + per_batch]] for own in places for k in range(0, size, per_batch)]

    batches = [
        (batch.agents, batch.keys, batch.state, batch.best)
        for training in trainings
        for batch in training.group_batches
    ]
    structure = jax.tree.structure(batches[0])
    leaves = [regrouped(*parts) for parts in zip(*map(jax.tree.leaves, batches), strict=True)]
    moved = [
        GroupBatch(*put_on_mesh(trainer.mesh, jax.tree.unflatten(structure, parts)))
        for parts in zip(*leaves, strict=True)
    ]
    per_shard = len(moved) // shards
    made = []
    for k, own in enumerate(places):
        training = Training(trainer, moved[k * per_shard : (k + 1) * per_shard], trainings[0].chunks_done)
        for name in ("episode_slots", "episodes", "scores"):
            if getattr(trainings[0], name):
                curves = np.concatenate([np.stack(getattr(old, name), 1) for old in trainings])
                setattr(training, name, list(curves[own].T))
        made.append(training)
    return made

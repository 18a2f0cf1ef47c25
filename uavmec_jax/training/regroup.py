"""Some agents of a population go on without the others, in fewer blocks of the same shape: nothing is compiled anew."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from uavmec_jax.training.programs import on_devices
from uavmec_jax.training.training import Training, Wave


def regroup(trainings: list[Training], members: np.ndarray) -> list[Training]:
    """Some agents of several blocks that are equally far, as fewer blocks of the same shape; the old ones are gone.

    Args:
        trainings: blocks of one population, in its order.
        members: places in the population, in the order that they are to have.
    """
    trainer, size = trainings[0].trainer, trainings[0].trainer.blocks.size
    everyone = [(wave.agents, wave.keys, wave.state, wave.best) for training in trainings for wave in training.waves]
    count = -(-len(members) // size)
    places = members[np.minimum(np.arange(count * size), len(members) - 1)]
    blocks = [places[k * size : (k + 1) * size] for k in range(count)]
    per_wave = size // trainer.blocks.groups * trainer.mesh.size

    def taken(*leaves: Any) -> list[Any]:
        whole = jnp.concatenate([jax.device_put(leaf, jax.local_devices()[0]) for leaf in leaves])
        return [whole[block[k : k + per_wave]] for block in blocks for k in range(0, size, per_wave)]

    leaves, shape = jax.tree.flatten(everyone[0])
    every = [jax.tree.leaves(one) for one in everyone]
    pieces = [taken(*(one[k] for one in every)) for k in range(len(leaves))]
    waves = [
        Wave(*on_devices(trainer.mesh, jax.tree.unflatten(shape, [piece[k] for piece in pieces])))
        for k in range(len(pieces[0]))
    ]
    n = len(waves) // count
    made = []
    for k, block in enumerate(blocks):
        training = Training(trainer, waves[k * n : (k + 1) * n], done=trainings[0].done)
        for name in ("slots", "episodes", "scores"):
            if getattr(trainings[0], name):
                curves = np.concatenate([np.stack(getattr(old, name), 1) for old in trainings])
                setattr(training, name, list(curves[block].T))
        made.append(training)
    return made

"""Options of a run. The command line reads its defaults from here, so nothing heavy is imported."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from uavmec_jax.errors import ArgumentError

CheckpointKind = Literal["full", "weights"]
CHECKPOINT_KINDS: tuple[CheckpointKind, ...] = get_args(CheckpointKind)
"""``full``: the whole training state, from which a shard resumes. ``weights``: only the current policies, which is small; a
shard that was stopped is trained again from its start."""


@dataclass(frozen=True)
class RunOptions:
    """How a run is checkpointed and logged.

    Attributes:
        checkpoint: what a checkpoint of a shard in training holds.
        checkpoint_every_s: least seconds between two checkpoints.
        checkpoint_share: largest share of the time spent on checkpoints: large ones are written less often.
        tensorboard: whether curves are also written as TensorBoard event files.

    Raises:
        ArgumentError: a value is not one that it may have.
    """

    checkpoint: CheckpointKind = "full"
    checkpoint_every_s: float = 60.0
    checkpoint_share: float = 0.02
    tensorboard: bool = False

    def __post_init__(self) -> None:
        if self.checkpoint not in CHECKPOINT_KINDS:
            raise ArgumentError(f"checkpoint is {self.checkpoint!r}; known: {', '.join(CHECKPOINT_KINDS)}")
        if not (isinstance(self.checkpoint_every_s, int | float) and 0 <= self.checkpoint_every_s < math.inf):
            raise ArgumentError(
                f"checkpoint_every_s is {self.checkpoint_every_s!r}; give a finite number of seconds from 0"
            )
        if not (isinstance(self.checkpoint_share, int | float) and 0 < self.checkpoint_share <= 1):
            raise ArgumentError(f"checkpoint_share is {self.checkpoint_share!r}; give a share above 0, at most 1")

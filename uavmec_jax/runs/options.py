"""How a run is checkpointed and logged. Imports nothing heavy: the command line reads names and defaults from here."""

from dataclasses import dataclass
from typing import Literal, get_args

CheckpointKind = Literal["full", "weights"]
CHECKPOINT_KINDS: tuple[CheckpointKind, ...] = get_args(CheckpointKind)
"""``full``: everything, a shard resumes from there. ``weights``: the present policies, small; a shard that was stopped is
trained again from its start."""


@dataclass(frozen=True)
class RunOptions:
    """How a run is checkpointed and logged.

    Attributes:
        checkpoint: what is saved of a shard in training.
        checkpoint_every_s: least time between two checkpoints.
        checkpoint_share: largest share of the time that they may take; large ones are further apart.
        lease_s: seconds without a heartbeat after which a worker on another machine counts as dead.
        tensorboard: whether curves are also written as TensorBoard event files.
    """

    checkpoint: CheckpointKind = "full"
    checkpoint_every_s: float = 60.0
    checkpoint_share: float = 0.02
    lease_s: float = 60.0
    tensorboard: bool = False

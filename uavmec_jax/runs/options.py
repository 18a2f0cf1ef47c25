"""Options of a run. The command line reads its defaults from here, so nothing heavy is imported."""

from dataclasses import dataclass
from typing import Literal, get_args

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
    """

    checkpoint: CheckpointKind = "full"
    checkpoint_every_s: float = 60.0
    checkpoint_share: float = 0.02
    tensorboard: bool = False

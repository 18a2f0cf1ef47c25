"""Carry out the shards of a run in this process, one after the other."""

import json
import traceback
from collections.abc import Callable

from uavmec_jax.errors import StudyError
from uavmec_jax.files.locations import is_local, make_folder, reason_of
from uavmec_jax.files.writing import write_text
from uavmec_jax.runs.attempt import Attempt
from uavmec_jax.runs.folder import RunFolder
from uavmec_jax.runs.log import RunLog
from uavmec_jax.runs.run_plan import Shard
from uavmec_jax.runs.shard_runner import ShardRunner
from uavmec_jax.runs.signals import StopSignal
from uavmec_jax.training.population import Progress

OnProgress = Callable[[Progress], None]


def run_here(folder: RunFolder, runner: ShardRunner, stop: StopSignal, log: RunLog, on_progress: OnProgress) -> None:
    """Make an attempt at every shard that is neither finished nor failed.

    Raises:
        Interrupted: a signal arrived; the shard in training has a checkpoint.
        StudyError: a file could not be written.
    """
    plan, done = folder.plan, 0
    for shard in plan.shards:
        if not folder.is_closed(shard):

            def on_chunk(steps: int, length: float, shard: Shard = shard, before: int = done) -> None:
                on_progress(Progress(shard.number, before + steps, plan.work, length))

            attempt = Attempt(folder, shard, folder.new_attempt(shard), runner, stop, log, on_chunk)
            try:
                attempt.run()
            except (OSError, MemoryError) as error:
                raise not_written(folder, shard, error) from error
            except Exception as error:
                record_failure(folder, shard, f"{type(error).__name__}: {error}", traceback.format_exc(), log)
        done += plan.work_of(shard)


def record_failure(folder: RunFolder, shard: Shard, error: str, trace: str, log: RunLog) -> None:
    """Write why a shard failed, so that the other shards go on without it."""
    make_folder(folder.shard_folder(shard))
    write_text(folder.failure(shard), json.dumps({"error": error, "traceback": trace}, indent=1) + "\n")
    log.event("failed", shard=shard.number, error=error)


def not_written(folder: RunFolder, shard: Shard, error: OSError | MemoryError) -> StudyError:
    """Return the error of a run whose files cannot be written."""
    reason = reason_of(error) if isinstance(error, OSError) else str(error)
    mended = "there is space" if is_local(folder.path) else "the store can be reached"
    return StudyError(
        f"{folder.shard_folder(shard)}: cannot be written: {reason}; earlier checkpoints are intact; when {mended}, "
        f"resume with: uavmec resume {folder.path}"
    )

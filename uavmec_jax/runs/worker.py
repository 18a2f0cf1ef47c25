"""A worker: claims the shards of a run, trains and evaluates them, and takes over from workers that died."""

import json
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from uavmec_jax.errors import StudyError
from uavmec_jax.files.leases import Lease, LeaseLostError, Leases
from uavmec_jax.files.writing import write_text
from uavmec_jax.runs.checkpoints import Checkpoints
from uavmec_jax.runs.folder import LOG, RunFolder
from uavmec_jax.runs.log import OnEvent, RunLog
from uavmec_jax.runs.run_plan import Shard
from uavmec_jax.runs.shard_runner import ShardRunner
from uavmec_jax.runs.signals import StopSignal
from uavmec_jax.scenarios.policy_files import PolicyCollection
from uavmec_jax.studies.results import policy_collection
from uavmec_jax.studies.shard_result import ShardResult
from uavmec_jax.training.population import Progress
from uavmec_jax.training.training import Training

OnProgress = Callable[[Progress], None]

POLL_S = 1.0
"""Seconds between checks of shards that other workers hold."""


@dataclass
class Worker:
    """One process that works on a run.

    Attributes:
        folder: folder of the run.
        runner: trains and evaluates shards.
        stop: checked between chunks.
        log: log of this process.
        on_progress: called after every chunk and shard.
        leases: claims shards for this process.
    """

    folder: RunFolder
    runner: ShardRunner
    stop: StopSignal
    log: RunLog
    on_progress: OnProgress = lambda _: None
    leases: Leases = field(default_factory=Leases)
    _closed: dict[int, int] = field(default_factory=dict)
    """Finished and failed shards -> the work that they count for."""

    def work(self, *, wait: bool = True) -> None:
        """Work until every shard is finished or has failed; without ``wait``, until no shard is free.

        Raises:
            Interrupted: a signal arrived; the current shard has a checkpoint.
            StudyError: a file could not be written.
        """
        while True:
            claimed = self._claim()
            if claimed is not None:
                self._run(*claimed)
            elif len(self._closed) == len(self.folder.plan.shards) or not wait:
                return
            else:
                with self.stop.interruptible():
                    time.sleep(min(POLL_S, self.leases.lease_s / 4))

    def reopen(self, shards: Iterable[int]) -> None:
        """Run these shards again, because their results turned out to be damaged."""
        for number in shards:
            self._closed.pop(number, None)

    def _claim(self) -> tuple[Shard, Lease] | None:
        """Claim the first shard that no worker holds."""
        for shard in self.folder.plan.shards:
            if shard.number in self._closed or self._is_closed(shard):
                continue
            shard_folder = self.folder.shard_folder(shard)
            taken_over = self.leases.taken_over(shard_folder)
            if (lease := self.leases.claim(shard_folder)) is not None:
                if self._is_closed(shard):  # another worker has just finished it
                    lease.release()
                    continue
                self.log.event("claimed", shard=shard.number, claim=lease.number, taken_over=taken_over)
                return shard, lease
        return None

    def _is_closed(self, shard: Shard) -> bool:
        """Return whether a shard is finished or has failed."""
        if self.folder.complete or self.folder.result(shard).exists():
            self._closed[shard.number] = self.folder.plan.work_of(shard)
        elif self.folder.failure(shard).exists():
            self._closed[shard.number] = 0
        return shard.number in self._closed

    def _run(self, shard: Shard, lease: Lease) -> None:
        """Run a shard, and write its result or why it failed."""
        started = time.monotonic()
        try:
            result = self._train_and_evaluate(shard, lease)
            lease.check()
            result.seconds["wall"] = time.monotonic() - started
            result.write(self.folder.result(shard))
            self._checkpoints(shard).remove()
            self.log.event("done", shard=shard.number, agents=shard.agents, seconds=result.seconds)
        except LeaseLostError as error:
            self.log.event("lost", shard=shard.number, error=str(error))
            return  # another worker holds the lease now
        except (OSError, MemoryError) as error:  # not the shard's fault: another machine may succeed
            self.log.event("stopped", shard=shard.number, error=str(error))
            lease.release()
            reason = getattr(error, "strerror", None) or error
            raise StudyError(
                f"{self.folder.shard_folder(shard)}: cannot be written: {reason}; earlier checkpoints are intact; when "
                f"there is space, resume with: uavmec resume {self.folder.path}"
            ) from error
        except Exception as error:
            facts = {"error": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()}
            write_text(self.folder.failure(shard), json.dumps(facts, indent=1) + "\n")
            self.log.event("failed", shard=shard.number, error=facts["error"])
        except KeyboardInterrupt as error:
            self.log.event("stopped", shard=shard.number, error=str(error))
            lease.release()
            raise
        lease.release()

    def _train_and_evaluate(self, shard: Shard, lease: Lease) -> ShardResult:
        if self.folder.plan.steps[shard.part] == 0:
            with self.stop.interruptible():
                result = self.runner.finish(shard, None)
            self.on_progress(self._progress(shard, shard.agents, float("nan")))
            return result
        checkpoints = self._checkpoints(shard)
        training = checkpoints.resume(lambda: _start(self.runner, shard))
        try:
            self.stop.check()
            for _ in training.run():
                self._report(shard, lease, training)
                if checkpoints.is_due and not training.finished:
                    lease.check()
                    checkpoints.write(training)
                self.stop.check()
            with self.stop.interruptible():
                return self.runner.finish(shard, training)
        except KeyboardInterrupt:
            if training.consistent:
                lease.check()
                checkpoints.write(training)
            raise

    def _report(self, shard: Shard, lease: Lease, training: Training) -> None:
        steps = shard.agents * training.steps
        speed = steps / max(training.seconds["train"] + training.seconds["validate"], 1e-9)
        lease.progress.update(steps=steps, speed=speed)
        values = {"episode_length": training.mean_episode_length, "steps_per_second": speed}
        if training.validated:
            values["validation"] = float(training.scores[-1][: shard.agents].mean())
        self.log.curve(shard.number, training.steps, **values)
        self.on_progress(self._progress(shard, steps, training.mean_episode_length))

    def _progress(self, shard: Shard, steps: int, mean_episode_length: float) -> Progress:
        done = sum(self._closed.values()) + steps
        return Progress(shard.number, done, self.folder.plan.work, mean_episode_length)

    def _checkpoints(self, shard: Shard) -> Checkpoints:
        options = self.folder.options

        def collect(weights: dict) -> PolicyCollection:
            algorithm = self.runner.algorithm(shard)
            return policy_collection(self.folder.study, {algorithm: self.runner.agent_ids(shard)}, {algorithm: weights})

        size = self.folder.plan.partitions[shard.part].shard_bytes
        return Checkpoints(
            folder=self.folder.shard_folder(shard),
            kind=options.checkpoint,
            every_s=options.checkpoint_every_s,
            share=options.checkpoint_share,
            bytes=size if options.checkpoint == "full" else 0,
            identity={"run": self.folder.fingerprint, "shard": shard.number, "agents": shard.agents},
            log_event=lambda event, **facts: self.log.event(event, shard=shard.number, **facts),
            collect=collect,
        )


def _start(runner: ShardRunner, shard: Shard) -> Training:
    training = runner.start(shard)
    assert training is not None
    return training


def make_worker(
    path: Path,
    *,
    runner: ShardRunner | None = None,
    stop: StopSignal,
    on_progress: OnProgress = lambda _: None,
    on_event: OnEvent = lambda event, facts: None,
) -> Worker:
    """Make a worker for the run in a folder.

    Raises:
        StudyError: the folder holds no run, or the run plan is damaged.
    """
    folder = RunFolder.open(path)
    return Worker(
        folder=folder,
        runner=runner or ShardRunner(folder.study, folder.plan),
        stop=stop,
        log=RunLog(path / LOG, tensorboard=folder.options.tensorboard, on_event=on_event),
        on_progress=on_progress,
        leases=Leases(folder.options.lease_s),
    )

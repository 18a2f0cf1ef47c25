"""A worker: claims shards of a run, trains and judges them, and takes over those of workers that died."""

import json
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from uavmec_jax.errors import StudyError
from uavmec_jax.files.leases import Lease, LeaseLostError, Leases
from uavmec_jax.files.writing import write_text
from uavmec_jax.runs.checkpoints import Snapshots
from uavmec_jax.runs.folder import LOG, RunFolder
from uavmec_jax.runs.log import Log
from uavmec_jax.runs.run_plan import Shard
from uavmec_jax.runs.shard_runner import Bench
from uavmec_jax.runs.signals import Stop
from uavmec_jax.scenarios.policy_files import Collection
from uavmec_jax.studies.results import policy_collection
from uavmec_jax.studies.shard_result import Finished
from uavmec_jax.training.population import Progress
from uavmec_jax.training.training import Training

OnProgress = Callable[[Progress], None]
OnEvent = Callable[[str, dict[str, Any]], None]

POLL_S = 1.0
"""Seconds between looks at shards that others hold."""


@dataclass
class Worker:
    """One process at work in a run's folder.

    Attributes:
        folder: of the run.
        bench: trains and judges.
        stop: asked between chunks.
        log: told what happens.
        on_progress: told after every chunk and shard.
        leases: of this process.
    """

    folder: RunFolder
    bench: Bench
    stop: Stop
    log: Log
    on_progress: OnProgress = lambda _: None
    leases: Leases = field(default_factory=Leases)
    _over: dict[int, int] = field(default_factory=dict)
    """Shard -> the work that was done in it, of those that are finished or have failed."""

    def work(self, *, wait: bool = True) -> None:
        """Until every shard is finished or has failed; without ``wait``, until none is free.

        Raises:
            Stopped: a signal came; the shard at hand is kept as it is.
            StudyError: something could not be written.
        """
        while True:
            found = self._claim()
            if found is not None:
                self._do(*found)
            elif len(self._over) == len(self.folder.plan.shards) or not wait:
                return
            else:
                with self.stop.at_once():
                    time.sleep(min(POLL_S, self.leases.lease_s / 4))

    def forget(self, shards: Iterable[int]) -> None:
        """These shards are not over after all."""
        for number in shards:
            self._over.pop(number, None)

    def _claim(self) -> tuple[Shard, Lease] | None:
        """The first shard that nobody works on."""
        for shard in self.folder.plan.shards:
            if shard.number in self._over or self._is_over(shard):
                continue
            place = self.folder.shard_folder(shard)
            again = self.leases.taken_over(place)
            if (lease := self.leases.claim(place)) is not None:
                if self._is_over(shard):  # somebody finished it between the two looks
                    lease.release()
                    continue
                self.log.tell("claimed", shard=shard.number, claim=lease.number, taken_over=again)
                return shard, lease
        return None

    def _is_over(self, shard: Shard) -> bool:
        if self.folder.complete or self.folder.result(shard).exists():
            self._over[shard.number] = self.folder.plan.work_of(shard)
        elif self.folder.failure(shard).exists():
            self._over[shard.number] = 0
        return shard.number in self._over

    def _do(self, shard: Shard, lease: Lease) -> None:
        tick = time.monotonic()
        try:
            finished = self._train_and_judge(shard, lease)
            lease.check()
            finished.seconds["wall"] = time.monotonic() - tick
            finished.write(self.folder.result(shard))
            self._snapshots(shard).remove()
            self.log.tell("done", shard=shard.number, agents=shard.agents, seconds=finished.seconds)
        except LeaseLostError as error:
            self.log.tell("lost", shard=shard.number, error=str(error))
            return  # and leave the lease alone: it is somebody else's
        except (OSError, MemoryError) as error:  # the machine's fault: another one may do better
            self.log.tell("stopped", shard=shard.number, error=str(error))
            lease.release()
            raise StudyError(
                f"{self.folder.shard_folder(shard)}: cannot be written: {getattr(error, 'strerror', None) or error}; what "
                f"was kept before is whole; when there is room, go on with: uavmec resume {self.folder.path}"
            ) from error
        except Exception as error:
            facts = {"error": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()}
            write_text(self.folder.failure(shard), json.dumps(facts, indent=1) + "\n")
            self.log.tell("failed", shard=shard.number, error=facts["error"])
        except KeyboardInterrupt as error:
            self.log.tell("stopped", shard=shard.number, error=str(error))
            lease.release()
            raise
        lease.release()

    def _train_and_judge(self, shard: Shard, lease: Lease) -> Finished:
        if self.folder.plan.steps[shard.algorithm] == 0:
            with self.stop.at_once():
                finished = self.bench.finish(shard, None)
            self.on_progress(self._progress(shard, shard.agents, float("nan")))
            return finished
        snapshots = self._snapshots(shard)

        def start() -> Training:
            training = self.bench.start(shard)
            assert training is not None
            return training

        training = snapshots.resume(start)
        try:
            while not training.finished:
                self.stop.check()
                training.advance()
                self._report(shard, lease, training)
                if snapshots.is_due and not training.finished:
                    lease.check()
                    snapshots.write(training)
            with self.stop.at_once():
                return self.bench.finish(shard, training)
        except KeyboardInterrupt:
            if training.sound:
                lease.check()
                snapshots.write(training)
            raise

    def _report(self, shard: Shard, lease: Lease, training: Training) -> None:
        steps = shard.agents * training.steps
        speed = steps / max(training.seconds["train"] + training.seconds["validate"], 1e-9)
        lease.news.update(steps=steps, speed=speed)
        values = {"episode_length": training.mean_length, "steps_per_second": speed}
        if training.looked:
            values["validation"] = float(training.scores[-1][: shard.agents].mean())
        self.log.curve(shard.number, training.steps, **values)
        self.on_progress(self._progress(shard, steps, training.mean_length))

    def _progress(self, shard: Shard, steps: int, mean_length: float) -> Progress:
        return Progress(shard.number, sum(self._over.values()) + steps, self.folder.plan.work, mean_length)

    def _snapshots(self, shard: Shard) -> Snapshots:
        durability = self.folder.durability

        def collection(weights: dict) -> Collection:
            who = {shard.algorithm: self.bench.who(shard)}
            return policy_collection(self.folder.study, who, {shard.algorithm: weights})

        return Snapshots(
            folder=self.folder.shard_folder(shard),
            kind=durability.snapshot,
            every_s=durability.snapshot_every_s,
            share=durability.snapshot_share,
            bytes=self.folder.plan.blocks[shard.algorithm].bytes if durability.snapshot == "full" else 0,
            facts={"run": self.folder.fingerprint, "shard": shard.number, "agents": shard.agents},
            tell=lambda event, **facts: self.log.tell(event, shard=shard.number, **facts),
            collection=collection,
        )


def make_worker(
    path: Path,
    *,
    bench: Bench | None = None,
    stop: Stop,
    on_progress: OnProgress = lambda _: None,
    on_event: OnEvent = lambda event, facts: None,
) -> Worker:
    """A worker for the run in a folder.

    Raises:
        StudyError: there is none, or its plan is damaged.
    """
    folder = RunFolder.open(path)
    log = Log(path / LOG, tensorboard=folder.durability.tensorboard, on_event=on_event)
    return Worker(
        folder=folder,
        bench=bench or Bench(folder.study, folder.plan),
        stop=stop,
        log=log,
        on_progress=on_progress,
        leases=Leases(folder.durability.lease_s),
    )
